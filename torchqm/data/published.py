"""Reader of the published result files of the SCB benchmark, ``BenchResult_<Method>_<Source>_to_<Target>.txt``.

A file is a sequence of blocks, ``Name:`` followed by lines ``<tab>Key<tab>[value, ...]``. What the blocks hold
(established from the benchmark's settings file and from its own summary pages, whose means the tests reproduce):

* ``Stats``: errors of the method's map at 1024 spread samples against the **plain** truth, and ``Time`` in seconds.
  Their vertex ids are in no file (settings: 1024 points, iterated farthest), so our errors can only be measured at
  points spread the same way.
* ``StatsWithFlip``: errors at the **landmarks** of the class (``.pid`` file, 21 to 46 points, not the 1024 samples).
  The map is compared with the plain and with the mirrored truth, the better one is kept for the whole map, and
  ``Flipped`` says which. Vertex ids are known here, so our errors under the protocol ``map`` compare point by point.
* ``Stats1``, ``StatsWithFlip1``, ...: lower-ranked candidate maps of the same run. They are read, and belong in no
  mean.

All errors are geodesic distances divided by the square root of the target's area.

So a flip is forgiven in ``StatsWithFlip`` only, and the means of the two blocks are over different points. Taking the
better *block* of each pair mixes them; the 0.0311 that is sometimes quoted for BIM is that mixture, pooled over points
(a pair then counts with 1024 points or with about 30). By the benchmark itself no BIM map is flipped, so BIM's
flip-forgiven error at the 1024 samples is its plain error.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.catalogue import PUBLISHED_METHODS

__all__ = [
    "PUBLISHED_METHODS",
    "PublishedBlock",
    "PublishedResult",
    "load_published",
    "natural_key",
    "published_names",
    "read_published",
]

RESULT_FOLDER = Path("Results") / "Results_Corr_TOSCA"

_FILE_NAME = re.compile(r"BenchResult_(?P<method>.+?)_(?P<source>[^_]+)_to_(?P<target>[^_]+)\.txt")


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which ``cat2`` comes before ``cat10``.

    Example:
        >>> sorted(["cat10", "cat2", "cat"], key=natural_key)
        ['cat', 'cat2', 'cat10']
    """
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", text) if part)


@dataclass(frozen=True, eq=False)
class PublishedBlock:
    """One block of a result file.

    Args:
        errors: ``(S,)`` geodesic errors / sqrt(area of the target).
        average: the mean that the file states.
        flipped: whether the mirrored truth was the better one for this map; None where only the plain truth was asked.
    """

    errors: Float[Tensor, " S"]
    average: float
    flipped: bool | None = None


@dataclass(frozen=True, eq=False)
class PublishedResult:
    """The published result of one method on one pair of shapes.

    Args:
        method: name of the method in the file name, a key of :data:`PUBLISHED_METHODS` for the original results.
        source: shape that is mapped.
        target: shape that it is mapped to; errors are measured there.
        blocks: the blocks by name, in the order of the file.
        seconds: running time; None where the file states none (0).
        path: the file.
    """

    method: str
    source: str
    target: str
    blocks: dict[str, PublishedBlock]
    seconds: float | None
    path: Path

    @property
    def plain(self) -> PublishedBlock:
        """``Stats``: 1024 spread samples, plain truth."""
        return self.blocks["Stats"]

    @property
    def landmarks(self) -> PublishedBlock | None:
        """``StatsWithFlip``: the landmarks, the better of plain and mirrored truth for the whole map."""
        return self.blocks.get("StatsWithFlip")


def published_names(folder: str | Path, method: str) -> list[tuple[str, str]]:
    """Pairs ``(source, target)`` with a result file of ``method`` in ``folder``, in natural order.

    Raises:
        FileNotFoundError: if the folder is missing or has no result of the method; the message lists the methods it
            has.
    """
    return [(source, target) for source, target, _ in _result_files(Path(folder), method)]


def load_published(root: str | Path, method: str = "BlendedMap") -> list[PublishedResult]:
    """All results of a method, in natural order of the pairs.

    Args:
        root: an SCB folder (results are looked for in ``Results/Results_Corr_TOSCA``) or the folder of the result
            files.
        method: as in the file names, see :data:`PUBLISHED_METHODS`.

    Raises:
        FileNotFoundError: if there is no such folder or no result of the method.
        ValueError: naming file and line, if a file is malformed or cut short.
    """
    folder = Path(root) / RESULT_FOLDER
    folder = folder if folder.is_dir() or not any(Path(root).glob("BenchResult_*.txt")) else Path(root)
    return [read_published(path) for _, _, path in _result_files(folder, method)]


def read_published(path: str | Path) -> PublishedResult:
    """Read one ``BenchResult_<Method>_<Source>_to_<Target>.txt``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file and line, if the file is malformed or cut short.
    """
    path = Path(path)
    name = _FILE_NAME.fullmatch(path.name)
    if name is None:
        raise ValueError(f"{path}: expected a name like BenchResult_BlendedMap_cat0_to_cat6.txt")
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; a published result was expected there")
    fields = _read_fields(path)
    if "Stats" not in fields:
        raise ValueError(f"{path}: no block 'Stats'; blocks found: {', '.join(fields) or 'none'}")
    blocks = {block: _block(path, block, entries) for block, entries in fields.items()}
    seconds = _number(path, *fields["Stats"]["Time"]) if "Time" in fields["Stats"] else 0.0
    return PublishedResult(name["method"], name["source"], name["target"], blocks, seconds or None, path)


def _result_files(folder: Path, method: str) -> list[tuple[str, str, Path]]:
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder} is not a folder; published results BenchResult_<Method>_<A>_to_<B>.txt were expected"
        )
    matches = [(match, path) for path in folder.iterdir() if (match := _FILE_NAME.fullmatch(path.name))]
    found = [(match["source"], match["target"], path) for match, path in matches if match["method"] == method]
    if not found:
        methods = ", ".join(sorted({match["method"] for match, _ in matches})) or "none"
        raise FileNotFoundError(
            f"{folder} has no BenchResult_{method}_<A>_to_<B>.txt; methods with results there: {methods}"
        )
    return sorted(found, key=lambda row: (natural_key(row[0]), natural_key(row[1])))


_Field = tuple[int, str]  # line number, text between the brackets


def _read_fields(path: Path) -> dict[str, dict[str, _Field]]:
    """The blocks of a file as ``{block: {key: (line number, text between the brackets)}}``."""
    blocks: dict[str, dict[str, _Field]] = {}
    current: dict[str, _Field] | None = None
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        if header := re.fullmatch(r"(\w+):\s*", line):
            if header[1] in blocks:
                raise ValueError(f"{path}:{number}: block {header[1]!r} occurs twice")
            current = blocks[header[1]] = {}
        elif current is None:
            raise ValueError(f"{path}:{number}: expected a block name such as 'Stats:', got {line[:60]!r}")
        elif entry := re.fullmatch(r"\s+(\w+)\s+\[(.*)\]\s*", line):
            current[entry[1]] = (number, entry[2])
        else:
            raise ValueError(
                f"{path}:{number}: expected 'Key [value, ...]', got {_shorten(line)} (is the file cut short?)"
            )
    return blocks


def _block(path: Path, name: str, entries: dict[str, _Field]) -> PublishedBlock:
    for key in ("Average", "PerSampleErrors"):
        if key not in entries:
            raise ValueError(f"{path}: block {name!r} has no {key} (is the file cut short?)")
    average = _number(path, *entries["Average"])
    number, text = entries["PerSampleErrors"]
    errors = _numbers(path, number, text)
    # The stated mean is a free checksum; six significant digits are printed.
    if abs(float(errors.mean()) - average) > 1e-4 * max(average, 1e-3):
        raise ValueError(
            f"{path}:{number}: the {len(errors)} errors of block {name!r} have mean {float(errors.mean()):.6g}, "
            f"but the file states Average {average:.6g} (are errors missing?)"
        )
    flipped = entries.get("Flipped")
    if flipped is not None and flipped[1] not in ("true", "false"):
        raise ValueError(f"{path}:{flipped[0]}: Flipped must be true or false, got {flipped[1]!r}")
    return PublishedBlock(errors, average, None if flipped is None else flipped[1] == "true")


def _numbers(path: Path, line: int, text: str) -> Float[Tensor, " S"]:
    words = text.split(",")
    try:
        values = torch.tensor([float(word) for word in words], dtype=torch.float64)
        usable = bool(((values >= 0) & (values < float("inf"))).all())
    except ValueError:
        usable = False
    return values if usable else torch.tensor([_number(path, line, word) for word in words])  # names the first bad one


def _number(path: Path, line: int, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{path}:{line}: expected a number, got {_shorten(text)}") from None
    if not 0 <= value < float("inf"):
        raise ValueError(f"{path}:{line}: expected a finite number, at least 0, got {text.strip()!r}")
    return value


def _shorten(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:40] + " ... " + text[-15:])
