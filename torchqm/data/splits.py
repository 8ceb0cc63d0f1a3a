"""Train, validation and test parts of a set of shapes, by name, drawn class by class and kept in a YAML file.

The file::

    layout: scb          # what the split was drawn for, for the reader
    seed: 0
    train: [cat0, cat1, cat2]
    validation: [cat3]
    test: [cat4]
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchqm.data.base import ShapeSet
from torchqm.geometry.files import write_whole

if TYPE_CHECKING:
    from yaml import Node

__all__ = ["PARTS", "Split", "SplitError", "draw_split", "own_split", "read_split_file", "write_split_file"]

PARTS = ("train", "validation", "test")
_NOTES = ("layout", "seed")


class SplitError(ValueError):
    """A split file that cannot be used; the message names file, line and fault."""


@dataclass(frozen=True)
class Split:
    """Names of the shapes of each part.

    Args:
        train: names to learn from.
        validation: names to choose by.
        test: names to report on.

    Raises:
        ValueError: a name is in two places.

    Example:
        >>> Split(train=("cat0", "cat1"), test=("dog0",)).part("test")
        ('dog0',)
    """

    train: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        seen: dict[str, str] = {}
        for part in PARTS:
            for name in self.part(part):
                if name in seen:
                    both = f"twice in {part}" if seen[name] == part else f"in {seen[name]} and in {part}"
                    raise ValueError(f"{part}: {name!r} stands {both}; each shape belongs to one part, once")
                seen[name] = part

    def part(self, name: str) -> tuple[str, ...]:
        """The names of one part.

        Raises:
            ValueError: there is no such part.
        """
        if name not in PARTS:
            raise ValueError(f"part is {name!r}; allowed are {', '.join(PARTS)}")
        return {"train": self.train, "validation": self.validation, "test": self.test}[name]


def draw_split(
    shapes: ShapeSet,
    shares: Sequence[float] = (0.7, 0.1, 0.2),
    seed: int = 0,
    whole_classes: bool = False,
    classes: Sequence[str] | None = None,
) -> Split:
    """Draw the parts class by class, so that each class is divided by the same shares.

    Numbers are rounded by largest remainder; what is left over goes to train first. The draw depends on the seed and
    on the names of the class alone: another class that joins the set changes nothing.

    Args:
        shapes: the set.
        shares: of train, validation and test; they sum to 1.
        seed: of the draw.
        whole_classes: give whole classes to the parts instead (to test on classes never seen).
        classes: those to divide; the others are in no part. All if not given.

    Returns:
        The parts, names in the set's order.

    Raises:
        ValueError: the shares are no shares.

    Example:
        >>> from torchqm.data.synthetic_set import SyntheticShapes
        >>> split = draw_split(SyntheticShapes("synthetic:poses=10"), (0.5, 0.2, 0.3))
        >>> len(split.train), len(split.validation), len(split.test)
        (10, 4, 6)
    """
    if len(shares) != 3 or not all(math.isfinite(s) and s >= 0 for s in shares) or abs(sum(shares) - 1) > 1e-6:
        raise ValueError(f"shares: given {tuple(shares)}; three numbers >= 0 that sum to 1 are needed")
    groups: dict[str, list[str]] = {}
    for name in shapes.names:
        if classes is None or shapes.shape_class(name) in classes:
            groups.setdefault(shapes.shape_class(name), []).append(name)
    part_of: dict[str, str] = {}
    if whole_classes:
        drawn = _divide(list(groups), shares, seed, "classes")
        part_of = {name: drawn[cls] for cls, names in groups.items() for name in names}
    else:
        for cls, names in groups.items():
            part_of |= _divide(names, shares, seed, cls)
    return Split(*(tuple(name for name in shapes.names if part_of.get(name) == part) for part in PARTS))


def _divide(items: list[str], shares: Sequence[float], seed: int, salt: str) -> dict[str, str]:
    exact = [share * len(items) for share in shares]
    counts = [int(value + 1e-9) for value in exact]
    by_remainder = sorted(range(3), key=lambda part: (round(counts[part] - exact[part], 9), part))
    for part in by_remainder[: len(items) - sum(counts)]:
        counts[part] += 1
    generator = torch.Generator().manual_seed(_mixed(seed, salt))
    order = torch.randperm(len(items), generator=generator).tolist()
    parts = [part for part, count in zip(PARTS, counts, strict=True) for _ in range(count)]
    return {items[number]: part for number, part in zip(order, parts, strict=True)}


def _mixed(seed: int, salt: str) -> int:
    """A seed of its own for each class; Python's own hash of a text changes from run to run."""
    import hashlib

    return int.from_bytes(hashlib.sha256(f"{seed} {salt}".encode()).digest()[:7], "big")


def own_split(shapes: ShapeSet) -> Split | None:
    """The split that a set ships (``train.txt``, ``test.txt``), or None.

    Raises:
        SplitError: nothing in it is for training, or nothing for testing.
    """
    parts = shapes.split()
    if parts is None:
        return None
    empty = [part for part in ("train", "test") if not parts.get(part)]
    if empty:
        raise SplitError(
            f"{shapes.root}: its own split has no {' and no '.join(empty)} shapes; 'torchqm data check' says more"
        )
    return Split(**{part: tuple(parts.get(part, ())) for part in PARTS})


def write_split_file(path: str | Path, split: Split, notes: Mapping[str, Any] | None = None) -> Path:
    """Write a split as YAML, whole or not at all.

    Args:
        path: where to.
        split: the parts.
        notes: ``layout`` and ``seed``, where they should stand in the file.

    Raises:
        ValueError: another note.
        OSError: the place cannot be written to.
    """
    import yaml

    wrong = sorted(set(notes or {}) - set(_NOTES))
    if wrong:
        raise ValueError(f"notes: {', '.join(map(repr, wrong))} given; allowed are {', '.join(_NOTES)}")
    content = {**(notes or {}), **{part: list(split.part(part)) for part in PARTS}}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=100)
    return write_whole(path, lambda file: file.write(text.encode()))


def read_split_file(path: str | Path, shapes: ShapeSet | None = None) -> Split:
    """Read a split from YAML.

    Args:
        path: the file.
        shapes: the set that the names belong to; they are not checked if it is not given.

    Returns:
        The parts; one that the file does not have is empty.

    Raises:
        SplitError: the file cannot be read or is no YAML, has another key, something else than a list of names, a name
            in two places, or one that the set does not have; with file and line.
    """
    import yaml

    path = Path(path)
    try:
        # Nodes instead of values: they know their lines, and "001" stays a name.
        root = yaml.compose(path.read_text("utf-8"), Loader=yaml.SafeLoader)
    except OSError as error:
        raise SplitError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise SplitError(f"{path}: not a text file (byte {error.start} is no UTF-8)") from error
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise SplitError(f"{path}{line}: no YAML: {error.problem}") from error
    except yaml.YAMLError as error:
        raise SplitError(f"{path}: no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(root, yaml.MappingNode):
        raise SplitError(f"{path}: expected the keys {', '.join(PARTS)}, each with a list of names")
    parts: dict[str, tuple[str, ...]] = {}
    lines: dict[str, tuple[str, int]] = {}
    known = None if shapes is None else set(shapes.names)
    for key, value in root.value:
        if key.value not in (*PARTS, *_NOTES):
            raise SplitError(f"{_at(path, key)}: unknown key {key.value!r}; allowed are {', '.join((*PARTS, *_NOTES))}")
        if key.value in parts:
            raise SplitError(f"{_at(path, key)}: {key.value!r} is given twice")
        if key.value in _NOTES:
            continue
        parts[key.value] = _names(path, key.value, value, lines, known, shapes)
    if not parts:
        raise SplitError(f"{path}: none of the keys {', '.join(PARTS)}")
    return Split(**parts)


def _names(
    path: Path,
    part: str,
    node: "Node",
    lines: dict[str, tuple[str, int]],
    known: set[str] | None,
    shapes: ShapeSet | None,
) -> tuple[str, ...]:
    """The names of one part; ``lines`` gathers where each name stands."""
    from yaml import ScalarNode, SequenceNode

    if isinstance(node, ScalarNode) and node.value in ("", "null", "~"):
        return ()
    if not isinstance(node, SequenceNode) or not all(isinstance(item, ScalarNode) for item in node.value):
        raise SplitError(f"{_at(path, node)}: {part} must be a list of names")
    for item in node.value:
        name = item.value
        if name in lines:
            where, line = lines[name]
            raise SplitError(f"{_at(path, item)}: {name!r} stands in {where} already (line {line})")
        if known is not None and shapes is not None and name not in known:
            raise SplitError(f"{_at(path, item)}: there is no shape {name!r} in {shapes.root}")
        lines[name] = part, item.start_mark.line + 1
    return tuple(item.value for item in node.value)


def _at(path: Path, node: "Node") -> str:
    return f"{path}:{node.start_mark.line + 1}"
