"""Readers of the mesh formats: each turns a path into positions and faces, or says what is wrong with the file."""

import re
import warnings
from bisect import bisect_left
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from torchqm.geometry.check import MeshError

__all__ = ["READERS", "numbers"]

# The filters of warnings are the whole process's: two files read at the same time would leave each other's behind.
_FILTERS = RLock()

_OFF_EDGE = re.compile(r"(?:2\s+)?\d+\s+\d+")
_OFF_HEADER = re.compile(r"^(?:(?:ST)?C?N?OFF\b|OFF(?=\d))")  # some writers glue the counts to the header: OFF490 518 0


class _Lines:
    """The lines of a text file that say something, and the way back to their numbers for messages."""

    def __init__(self, path: Path) -> None:
        self.path = path
        raw = path.read_bytes()
        if not raw:
            raise MeshError(f"{path}: the file is empty")
        if b"\0" in raw[:4096]:
            raise MeshError(f"{path}: not a text file, but {path.suffix} should be one")
        text = raw.decode("utf-8-sig", errors="replace")
        self._all = text.splitlines()
        stripped = (line.partition("#")[0].strip() for line in self._all) if "#" in text else map(str.strip, self._all)
        self.lines = [line for line in stripped if line]
        if not self.lines:
            raise MeshError(f"{path}: the file has no content but blank lines and comments")

    def number(self, index: int) -> int:
        """1-based line number in the file of ``self.lines[index]``."""
        kept = [k for k, line in enumerate(self._all, 1) if line.partition("#")[0].strip()]
        return kept[index] if index < len(kept) else len(self._all) + 1

    def fault(self, index: int, expected: str, found: str | None = None) -> MeshError:
        """An error about one line, which says what was expected there and what was found."""
        if index >= len(self.lines):
            found, where = "the end of the file", len(self._all)
        else:
            where = self.number(index)
            found = found or repr(self.lines[index][:60])
        return MeshError(f"{self.path}: line {where}: expected {expected}, found {found}")

    def table(self, rows: Sequence[int], width: int, what: str, skip: int = 0, kind: type = float) -> np.ndarray:
        """The first ``width`` numbers of some lines; further columns (colours, normals) are left out.

        ``rows`` are indices into ``self.lines`` (beyond the end for a truncated file); ``skip`` characters of each line
        come before the numbers.
        """
        block = [self.lines[i][skip:] for i in rows if i < len(self.lines)]
        columns = len(block[0].split()) if block else width
        flat = numbers(" ".join(block))
        if len(block) == len(rows) and columns >= width and flat is not None and len(flat) == len(rows) * columns:
            out = flat.reshape(len(rows), columns)[:, :width]
        else:  # lines of different lengths, or a fault: find out which
            out = np.empty((len(rows), width))
            for k, i in enumerate(rows):
                row = numbers(" ".join(block[k].split()[:width])) if k < len(block) else None
                if row is None or len(row) != width:
                    raise self.fault(i, f"{what} {k} of {len(rows)} ({width} numbers)")
                out[k] = row
        return self.whole(out, rows[0], what) if kind is int else out

    def whole(self, table: np.ndarray, start: int, what: str) -> np.ndarray:
        """The table as integers; an error for the first row that is not made of them."""
        good = (np.isfinite(table) & (np.abs(table) < 2**53) & (table == np.round(np.nan_to_num(table)))).all(1)
        if not good.all():
            raise self.fault(start + int((~good).argmax()), f"whole numbers for {what} {int((~good).argmax())}")
        return table.astype(np.int64)


def numbers(text: str, kind: type = np.float64) -> np.ndarray | None:
    """All numbers of a text, or None if something in it is none."""
    if not text:
        return np.zeros(0, dtype=kind)
    try:
        with _FILTERS, warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # numpy's way of saying that it stopped early
            return np.fromstring(text, dtype=kind, sep=" ")
    except (DeprecationWarning, ValueError):
        return None


def _fans(polygons: list[list[int]]) -> np.ndarray:
    """Triangles around the first corner of each polygon."""
    fans = [(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)]
    return np.array(fans, dtype=np.int64).reshape(-1, 3)


def _plain_off(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The usual OFF file, without a list of its lines; None if anything is unusual, right or wrong.

    ``OFF``, the counts, then one vertex or triangle a line, nothing between them or after them.
    """
    raw = path.read_bytes()
    if not raw.startswith(b"OFF\n") or b"#" in raw or b"\r" in raw:
        return None
    ends = np.flatnonzero(np.frombuffer(raw, dtype=np.uint8) == ord("\n"))
    if not raw.endswith(b"\n"):
        ends = np.append(ends, len(raw))
    counts = numbers(raw[4 : ends[1]].decode("ascii", errors="replace")) if len(ends) > 2 else None
    if counts is None or len(counts) != 3 or (counts < 0).any() or (counts % 1 != 0).any():
        return None
    n_verts, n_faces = int(counts[0]), int(counts[1])
    if min(n_verts, n_faces) == 0 or len(ends) != 2 + n_verts + n_faces or (np.diff(ends) < 6).any():
        return None  # "0 0 0" is the shortest line
    middle = int(ends[1 + n_verts])
    verts = numbers(raw[ends[1] + 1 : middle].decode("ascii", errors="replace"))
    faces = numbers(raw[middle + 1 :].decode("ascii", errors="replace"), np.int64)
    if verts is None or faces is None or len(verts) != 3 * n_verts or len(faces) != 4 * n_faces:
        return None
    table = faces.reshape(-1, 4)
    return (verts.reshape(-1, 3), np.ascontiguousarray(table[:, 1:])) if (table[:, 0] == 3).all() else None


def _read_off(path: Path) -> tuple[np.ndarray, np.ndarray]:
    plain = _plain_off(path)
    if plain is not None:
        return plain
    text = _Lines(path)
    header = _OFF_HEADER.match(text.lines[0])
    if header is None:
        raise text.fault(0, "a header OFF, COFF, NOFF, CNOFF or STOFF")
    rest = text.lines[0][header.end() :].strip()
    at = 0 if rest else 1  # the counts stand on the header line or on the next one
    counts = numbers(rest if rest else (text.lines[1] if len(text.lines) > 1 else ""))
    if counts is None or len(counts) < 2 or (counts[:2] < 0).any() or (counts[:2] % 1 != 0).any():
        raise text.fault(at, "the numbers of vertices, faces and edges")
    n_verts, n_faces = int(counts[0]), int(counts[1])
    start = at + 1
    if len(text.lines) < start + n_verts + n_faces:
        have = len(text.lines) - start
        found = f"{min(have, n_verts)} and {max(have - n_verts, 0)}"
        raise MeshError(
            f"{path}: truncated after line {text.number(len(text.lines) - 1)}: "
            f"expected {n_verts} vertices and {n_faces} faces, found {found}"
        )
    more = text.lines[start + n_verts + n_faces :]
    n_edges = counts[2] if len(counts) > 2 else 0  # hardly any file lists its edges, whatever it says here
    if more and not (len(more) == n_edges and all(map(_OFF_EDGE.fullmatch, more))):
        raise MeshError(
            f"{path}: the header declares {n_verts} vertices and {n_faces} faces, so {n_verts + n_faces} lines, but "
            f"{len(text.lines) - start} follow; the first too many is line "
            f"{text.number(start + n_verts + n_faces)}: {more[0][:60]!r}"
        )
    verts = text.table(range(start, start + n_verts), 3, "vertex")
    return verts, _off_faces(text, start + n_verts, n_faces)


def _off_faces(text: _Lines, start: int, count: int) -> np.ndarray:
    """Faces as ``corners id id id ... [colour]``."""
    block = text.lines[start : start + count]
    columns = len(block[0].split()) if block else 4
    flat = numbers(" ".join(block))
    if columns >= 4 and flat is not None and len(flat) == count * columns:
        table = flat.reshape(count, columns)
        if (table[:, 0] == 3).all():
            return text.whole(table[:, 1:4], start, "face")
    polygons = []
    for k, line in enumerate(block):
        words = line.split()
        size = int(words[0]) if words[0].isdigit() else 0
        row = numbers(" ".join(words[1 : 1 + size]))
        if size < 3 or row is None or len(row) != size:
            raise text.fault(start + k, f"face {k} of {count} (number of corners, at least 3, and their vertex ids)")
        polygons.append(text.whole(row[None], start + k, "face")[0].tolist())
    return _fans(polygons)


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    # Not through trimesh: it moves the triangles of quads to the end and renumbers vertices at texture seams.
    text = _Lines(path)
    at_verts = [i for i, line in enumerate(text.lines) if line.startswith(("v ", "v\t"))]
    at_faces = [i for i, line in enumerate(text.lines) if line.startswith(("f ", "f\t"))]
    if not at_verts and not at_faces:
        raise MeshError(f"{path}: no mesh: no line starts with 'v' or 'f' (line 1 is {text.lines[0][:60]!r})")
    verts = text.table(at_verts, 3, "vertex", skip=2) if at_verts else np.zeros((0, 3))
    block = [re.sub(r"/\S*", "", text.lines[i][2:]) for i in at_faces]  # id/uv/normal -> id
    flat = numbers(" ".join(block))
    plain = flat is not None and len(flat) == 3 * len(block) and all(len(line.split()) == 3 for line in block)
    if flat is not None and plain and (flat >= 1).all() and (flat % 1 == 0).all():
        return verts, flat.astype(np.int64).reshape(-1, 3) - 1
    polygons = []
    for i, line in zip(at_faces, block, strict=True):
        try:
            corners = [int(word) for word in line.split()]
        except ValueError:
            corners = []
        if len(corners) < 3 or 0 in corners:
            raise text.fault(i, "a face of at least 3 corners 'id', 'id/uv' or 'id/uv/normal', with ids from 1")
        seen = bisect_left(at_verts, i)  # negative ids count back from the vertices read so far
        polygons.append([c - 1 if c > 0 else seen + c for c in corners])
    return verts, _fans(polygons)


def _read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with path.open("rb") as file:
        head = file.read(64 * 1024)
    if not head.startswith(b"ply"):
        raise MeshError(f"{path}: not a PLY file: it starts with {head[:20]!r} instead of 'ply'")
    if b"end_header" not in head:
        raise MeshError(f"{path}: truncated: the PLY header has no end_header")
    header = head.partition(b"end_header")[0].decode("ascii", errors="replace")
    elements = [(name, int(n)) for name, n in re.findall(r"^element\s+(\S+)\s+(\d+)", header, re.MULTILINE)]
    declared = dict(elements)
    n_verts, n_faces = declared.get("vertex", 0), declared.get("face", 0)
    if n_verts == 0 or n_faces == 0:
        what = "vertices" if n_verts == 0 else "faces"
        raise MeshError(f"{path}: no {what}: the PLY header declares {n_verts} vertices and {n_faces} faces")
    if re.search(r"^format\s+ascii", header, re.MULTILINE):
        _check_ply_lines(path, elements)
    verts, faces = _through_trimesh(path, "ply")
    # trimesh takes what it finds of a file that was cut off; a fan never has fewer triangles than polygons.
    if len(verts) < n_verts or len(faces) < n_faces:
        raise MeshError(
            f"{path}: truncated: the header declares {n_verts} vertices and {n_faces} faces, "
            f"found {len(verts)} and {len(faces)}"
        )
    return verts, faces


def _check_ply_lines(path: Path, elements: list[tuple[str, int]]) -> None:
    """Refuse a text PLY with more lines than its header declares; trimesh would leave them out without a word."""
    lines = path.read_bytes().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(b"end_header")) + 1
    rows = [k for k in range(start, len(lines)) if lines[k].strip()]
    total = sum(count for _, count in elements)
    if len(rows) > total:
        first = lines[rows[total]][:60].decode("ascii", errors="replace")
        declared = ", ".join(f"{name} {count}" for name, count in elements)
        raise MeshError(
            f"{path}: the header declares {declared}, so {total} lines, but {len(rows)} follow; "
            f"the first too many is line {rows[total] + 1}: {first!r}"
        )


def _read_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = path.read_bytes()
    text = data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:4096]
    if text and not data.rstrip().splitlines()[-1].strip().lower().startswith(b"endsolid"):
        lines = data.rstrip().splitlines()
        last = lines[-1].decode("ascii", errors="replace").strip()
        raise MeshError(f"{path}: truncated: line {len(lines)}: expected endsolid, found {last[:60]!r}")
    if not text:
        count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
        if len(data) < 84 or len(data) < 84 + 50 * count or (count == 0 and len(data) > 84):
            raise MeshError(
                f"{path}: no STL or truncated: neither text between 'solid' and 'endsolid' nor "
                f"{84 + 50 * count} bytes for {count} triangles (found {len(data)} bytes)"
            )
        if count == 0:
            raise MeshError(f"{path}: no faces")
    return _through_trimesh(path, "stl")


def _through_trimesh(path: Path, kind: str) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    try:
        with path.open("rb") as file, _FILTERS, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = trimesh.load(file, file_type=kind, process=False)
    except Exception as error:  # a broken file can end in any exception of the parser
        raise MeshError(f"{path}: cannot be read as {kind.upper()} ({type(error).__name__}: {error})") from error
    if not hasattr(loaded, "vertices") or loaded.vertices is None:
        raise MeshError(f"{path}: no {kind.upper()} mesh in this file")
    faces = getattr(loaded, "faces", None)
    return (
        np.array(loaded.vertices, dtype=np.float64),
        np.zeros((0, 3), dtype=np.int64) if faces is None else np.array(faces, dtype=np.int64).reshape(-1, 3),
    )


def _read_mat(path: Path) -> tuple[np.ndarray, np.ndarray]:
    from scipy.io import loadmat

    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError as error:
        raise MeshError(f"{path}: MATLAB 7.3 files are not supported; save with -v7") from error
    except Exception as error:  # scipy raises many types on bytes that are no MAT file
        raise MeshError(f"{path}: no MATLAB file, or a truncated one ({error})") from error
    surface: Any = content.get("surface")
    missing = [k for k in ("X", "Y", "Z", "TRIV") if not hasattr(surface, k)]
    if missing:
        held = ", ".join(k for k in content if not k.startswith("__")) or "nothing"
        raise MeshError(f"{path}: no {', '.join(f'surface.{k}' for k in missing)} (the file holds {held})")
    try:
        x, y, z = (np.asarray(getattr(surface, k), dtype=np.float64).reshape(-1) for k in "XYZ")
        faces = np.asarray(surface.TRIV, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError) as error:
        raise MeshError(f"{path}: surface.X, Y, Z, TRIV are not arrays of numbers ({error})") from error
    if not len(x) == len(y) == len(z):
        raise MeshError(f"{path}: surface.X, Y, Z have {len(x)}, {len(y)} and {len(z)} entries, not the same number")
    if not (np.isfinite(faces) & (faces == np.round(faces))).all():
        raise MeshError(f"{path}: surface.TRIV holds numbers that are no vertex ids")
    return np.stack([x, y, z], axis=1), faces.astype(np.int64)


def _read_vert_tri(path: Path) -> tuple[np.ndarray, np.ndarray]:
    vert, tri = path.with_suffix(".vert"), path.with_suffix(".tri")
    for part, other in ((vert, tri), (tri, vert)):
        if not part.exists():
            raise MeshError(f"{part}: no such file; {other.name} needs it beside itself")
    positions, triangles = _Lines(vert), _Lines(tri)
    verts = positions.table(range(len(positions.lines)), 3, "vertex")
    for i, line in enumerate(triangles.lines):
        if len(line.split()) > 3:
            raise triangles.fault(i, "a triangle: 3 vertex ids and no more")
    return verts, triangles.table(range(len(triangles.lines)), 3, "face", kind=int)


READERS: dict[str, tuple[Callable[[Path], tuple[np.ndarray, np.ndarray]], int]] = {
    ".off": (_read_off, 0),
    ".obj": (_read_obj, 0),
    ".ply": (_read_ply, 0),
    ".stl": (_read_stl, 0),
    ".mat": (_read_mat, 1),
    ".vert": (_read_vert_tri, 1),
    ".tri": (_read_vert_tri, 1),
}
"""For each file ending the reader, and the number that its files give to the first vertex unless they hold a 0."""
