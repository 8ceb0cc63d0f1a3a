"""The small files of data sets: vertex ids and from what number they count, barycentric points, pairs, names."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchqm.geometry.formats import numbers
from torchqm.geometry.io import READABLE

__all__ = [
    "Ids",
    "IndexBase",
    "PairLine",
    "read_barycentric",
    "read_ids",
    "read_names",
    "read_pairs",
    "read_table",
    "recognise_base",
]


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Lines that say something, with their 1-based numbers; ``#`` begins a comment.

    Raises:
        ValueError: the file cannot be read, or is no text.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    if b"\0" in text[:4096]:
        raise ValueError(f"{path}: not a text file")
    lines = enumerate(text.decode("utf-8-sig", errors="replace").splitlines(), 1)
    stripped = ((number, line.partition("#")[0].strip()) for number, line in lines)
    return [(number, line) for number, line in stripped if line]


def read_table(path: Path, columns: Sequence[int] | None = None) -> np.ndarray:
    """A table of numbers.

    Args:
        path: text file, numbers with blanks or commas between them.
        columns: allowed numbers of columns; any if not given.

    Raises:
        ValueError: naming file and line, if a line is no row of numbers, or has another length than the first.
    """
    plain = _one_column(path) if columns is None else None
    if plain is not None:
        return plain
    lines = read_lines(path)
    if not lines:
        raise ValueError(f"{path}: the file is empty")
    text = "\n".join(line for _, line in lines).replace(",", " ")
    width = len(lines[0][1].replace(",", " ").split())
    if columns is not None and width not in columns:
        allowed = " or ".join(map(str, columns))
        raise ValueError(f"{path}:{lines[0][0]}: expected {allowed} numbers in a line, got {lines[0][1][:60]!r}")
    flat = numbers(text)
    even = flat is not None and len(flat) == width * len(lines)
    if even and (width == 1 or all(line.count(" ") + line.count(",") == width - 1 for _, line in lines)):
        return np.asarray(flat).reshape(len(lines), width)
    table = np.empty((len(lines), width))
    for k, (number, line) in enumerate(lines):
        row = numbers(line.replace(",", " "))
        if row is None or len(row) != width:
            many = f"{width} numbers" if width > 1 else "one number"
            raise ValueError(f"{path}:{number}: expected {many}, got {line[:60]!r}")
        table[k] = row
    return table


def _one_column(path: Path) -> np.ndarray | None:
    """One number a line and nothing else, which nearly all of these files are; None for any other file."""
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return None  # the slow way says what is wrong
    flat = None if "#" in text or not text else numbers(text)
    if flat is None or len(flat) != text.count("\n") + 1 or any(blank in text for blank in (" ", "\t", "\n\n")):
        return None
    return flat[:, None]


@dataclass(frozen=True, eq=False)
class Ids:
    """Ids as a file has them.

    Args:
        path: the file.
        values: ``(S,)`` int64 ids, not yet counted from 0.
    """

    path: Path
    values: np.ndarray

    def line(self, row: int) -> int:
        """Number of the line that an id stands in (the file is read again: only messages need it)."""
        return read_lines(self.path)[row][0]

    def checked(self, base: int, count: int, owner: str, what: str = "vertex") -> np.ndarray:
        """The ids counted from 0.

        Raises:
            ValueError: naming file and line of the first id that ``owner`` does not have.
        """
        bad = (self.values < base) | (self.values >= count + base)
        if bad.any():
            at = int(bad.argmax())
            raise ValueError(
                f"{self.path}:{self.line(at)}: {what} {self.values[at]} is out of range: {owner} has {count}, "
                f"{base} to {count - 1 + base} counted from {base} ({int(bad.sum())} of {len(bad)} lines are)"
            )
        return self.values - base


def read_ids(path: Path, column: int = 0, columns: Sequence[int] | None = None) -> Ids:
    """The ids in one column of a file (``.vts``, ``.map``; SHREC07 has three zeros behind each id).

    Raises:
        ValueError: naming file and line, if an entry is no whole number.
    """
    values = read_table(path, columns)[:, column]
    whole = np.isfinite(values) & (values == np.round(np.nan_to_num(values)))
    ids = Ids(path, np.where(whole, values, 0).astype(np.int64))
    if not whole.all():
        at = int((~whole).argmax())
        raise ValueError(f"{path}:{ids.line(at)}: expected a whole number, got {values[at]:g}")
    return ids


def read_barycentric(path: Path) -> tuple[Ids, np.ndarray]:
    """Points inside triangles, ``triangle w1 w2 w3`` a line (``.baryc_gt`` of SHREC16).

    Returns:
        The triangle numbers as in the file, and ``(S, 3)`` weights that sum to exactly one.

    Raises:
        ValueError: naming file and line, if a row is malformed or its weights are no barycentric coordinates.
    """
    faces, weights = read_ids(path, 0, (4,)), read_table(path)[:, 1:]
    bad = ~((weights >= -1e-3).all(1) & (np.abs(weights.sum(1) - 1) <= 1e-2))
    if bad.any():
        at = int(bad.argmax())
        raise ValueError(
            f"{path}:{faces.line(at)}: expected three weights >= 0 that sum to 1, got "
            f"{', '.join(f'{weight:g}' for weight in weights[at])}"
        )
    weights = weights.clip(0, None)
    return faces, weights / weights.sum(1, keepdims=True)


@dataclass(frozen=True)
class IndexBase:
    """From what number ids count, and why that is believed.

    Args:
        base: 0 or 1.
        why: the sentence for ``recognised``.
    """

    base: int
    why: str


def recognise_base(what: str, files: Iterable[tuple[np.ndarray, int]], default: int) -> IndexBase:
    """From what number a family of files counts: each file with an id 0, or an id equal to the count, has a vote.

    Args:
        what: the files in words, for the sentence.
        files: ids of each file and the number of things they count.
        default: what the layout does by custom, where no file has a vote (or as many say 0 as say 1).

    Example:
        >>> recognise_base("corres/*.vts", [(np.array([1, 5]), 5), (np.array([2, 3]), 5)], 0).why
        'corres/*.vts: 1-based (1 of 2 files have an id equal to the count, none an id 0)'
    """
    zero = one = total = 0
    for ids, count in files:
        total += 1
        low, high = bool((ids == 0).any()), bool((ids == count).any())
        zero += low and not high  # a file with both contradicts itself and has no vote
        one += high and not low
    files_ = f"of {total} file{'s' if total != 1 else ''} have"
    if one > zero:
        but = f"{zero} an id 0" if zero else "none an id 0"
        return IndexBase(1, f"{what}: 1-based ({one} {files_} an id equal to the count, {but})")
    if zero > one:
        but = f"{one} one equal to the count" if one else "none one equal to the count"
        return IndexBase(0, f"{what}: 0-based ({zero} {files_} an id 0, {but})")
    reason = "as many files say 0 as say 1" if zero else "no file has an id 0, or one equal to the count"
    return IndexBase(default, f"{what}: taken as {default}-based, as this layout does by custom ({reason})")


@dataclass(frozen=True)
class PairLine:
    """A line of a pairs file.

    Args:
        line: its number.
        first: name of the first shape.
        second: name of the second shape.
        extra: a third word, such as a file with the truth.
    """

    line: int
    first: str
    second: str
    extra: str | None = None


def read_pairs(path: Path, known: Iterable[str] = ()) -> list[PairLine]:
    """Pairs of names, two a line (a third word may follow), with blanks or a comma between them.

    A first line that says ``first second`` or ``source target`` is a heading, if no shape has such a name.

    Args:
        path: the file.
        known: names of shapes.

    Raises:
        ValueError: naming file and line.
    """
    pairs: list[PairLine] = []
    for number, line in read_lines(path):
        words = [_without_ending(word) if k < 2 else word for k, word in enumerate(line.replace(",", " ").split())]
        if len(words) not in (2, 3):
            raise ValueError(
                f"{path}:{number}: expected two names, and perhaps a file with the truth, got {line[:60]!r}"
            )
        heading = tuple(word.lower() for word in words[:2]) in (("first", "second"), ("source", "target"))
        if heading and not pairs and not set(words[:2]) & set(known):
            continue
        pairs.append(PairLine(number, *words))
    return pairs


def read_names(path: Path) -> list[tuple[int, str]]:
    """Names of shapes, one a line, with line numbers; endings of mesh files are left out."""
    return [(number, _without_ending(line)) for number, line in read_lines(path)]


def _without_ending(word: str) -> str:
    stem, dot, ending = word.rpartition(".")
    return stem if dot and f".{ending.lower()}" in READABLE else word
