"""Which pairs of a set of shapes are matched: all of them, those of a class, the published ones, or those of a file."""

from difflib import get_close_matches
from itertools import product
from pathlib import Path

from torchqm.catalogue import PAIRS_HELP
from torchqm.data.base import ShapeSet
from torchqm.data.files import read_pairs

__all__ = ["PAIRS_HELP", "choose_pairs"]

_WORDS = ("all", "unordered", "within-class", "published", "scb", "self")


def choose_pairs(shapes: ShapeSet, spec: str | Path = "all") -> list[tuple[str, str]]:
    """The pairs ``(first, second)`` of a set that a specification asks for.

    * ``all``: every ordered pair of different shapes. ``unordered``: each once, in the order of the set's names.
    * ``within-class``: ordered pairs of one class; ``within-class+unordered``: each of them once.
    * ``published``, also ``scb``: those that the set has published results for.
    * anything else is a text file with two names a line, blanks or a comma between them; ``#`` begins a comment, a line
      ``first second`` or ``source target`` above the pairs is a heading, endings of mesh files are left out.

    ``+self`` adds each shape with itself: the learned methods' ``all+self`` has 400 pairs on the 20 test shapes of
    FAUST, others score the 190 of ``unordered``.

    Args:
        shapes: the set.
        spec: one of the words above, joined by ``+``, or the path of a file.

    Returns:
        The pairs without repetition, in the order of the names or of the file.

    Raises:
        ValueError: an unknown word, a file that cannot be read, a malformed line, a shape that the set does not have or
            a pair that stands there twice (naming file and line), or no pair at all.

    Example:
        >>> from torchqm.data.synthetic_set import SyntheticShapes
        >>> shapes = SyntheticShapes("synthetic:kinds=biped,octopus;poses=2")
        >>> [len(choose_pairs(shapes, spec)) for spec in ("all", "all+self", "unordered", "within-class")]
        [12, 16, 6, 4]
        >>> choose_pairs(shapes, "within-class+unordered")
        [('biped-0-pose0', 'biped-0-pose1'), ('octopus-0-pose0', 'octopus-0-pose1')]
    """
    words = str(spec).split("+")
    if not isinstance(spec, Path) and all(word in _WORDS for word in words):
        pairs, what = _by_words(shapes, words, str(spec)), f"pairs {str(spec)!r}"
    else:
        pairs, what = _from_file(shapes, Path(spec)), str(spec)
    if not pairs:
        raise ValueError(f"{what}: no pair in {shapes.root} ({shapes.layout}, {len(shapes.names)} shapes)")
    return pairs


def _by_words(shapes: ShapeSet, words: list[str], spec: str) -> list[tuple[str, str]]:
    if words.count("published") + words.count("scb"):
        if len(words) > 1:
            raise ValueError(f"pairs {spec!r}: the published pairs go with no other word")
        return shapes.published_pairs()
    if len(set(words)) < len(words) or {"all", "unordered"} <= set(words) or words == ["self"]:
        raise ValueError(f"pairs {spec!r}: allowed are {PAIRS_HELP}")
    names = shapes.names
    numbers = {name: number for number, name in enumerate(names)}
    classes = {name: shapes.shape_class(name) if "within-class" in words else "" for name in names}
    return [
        (a, b)
        for a, b in product(names, names)
        if classes[a] == classes[b]
        and (a != b or "self" in words)
        and ("unordered" not in words or numbers[a] <= numbers[b])
    ]


def _from_file(shapes: ShapeSet, path: Path) -> list[tuple[str, str]]:
    if not path.exists():
        raise ValueError(f"pairs {str(path)!r}: no such file, and no known word; allowed are {PAIRS_HELP}")
    known = set(shapes.names)
    lines: dict[tuple[str, str], int] = {}
    for entry in read_pairs(path, known):
        pair = entry.first, entry.second
        for name in pair:
            if name not in known:
                raise ValueError(f"{path}:{entry.line}: {_absent(shapes, name)}")
        if pair in lines:
            raise ValueError(f"{path}:{entry.line}: {pair[0]} {pair[1]} stands in line {lines[pair]} already")
        lines[pair] = entry.line
    return list(lines)


def _absent(shapes: ShapeSet, name: str) -> str:
    """The sentence about a name that is no shape of the set."""
    reason = getattr(shapes, "excluded", {}).get(name)
    if reason:
        return f"{name!r} is no usable shape of {shapes.root}: {reason}"
    near = get_close_matches(name, shapes.names, 3, 0.5)
    hint = f"the nearest names are {', '.join(near)}" if near else f"names are like {', '.join(shapes.names[:3])}"
    return f"there is no shape {name!r} in {shapes.root}; {hint}"
