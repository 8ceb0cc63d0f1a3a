"""Mesh files of a folder: which there are, how many vertices they have, and whether they are what they should be."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchqm.data.published import natural_key
from torchqm.geometry.check import MeshError
from torchqm.geometry.formats import READERS
from torchqm.geometry.io import load_mesh

__all__ = ["MESH_ENDINGS", "look_at_mesh", "mesh_files", "raw_faces", "vertex_count"]

MESH_ENDINGS = (".off", ".obj", ".ply", ".stl")
"""Endings that make a file of a folder a mesh whatever else lies there (``.mat`` and ``.vert`` may be other things)."""

_OFF_HEADER = re.compile(rb"^(?:\xef\xbb\xbf)?\s*(?:ST)?C?N?OFF\s+(\d+)\s+(\d+)(?:[ \t]+\d+)?[ \t]*\r?\n")
_NUMBER_BYTES = b"0123456789+-.eE \t\r\n"


def mesh_files(folder: Path, endings: Sequence[str] = MESH_ENDINGS) -> dict[str, Path]:
    """Mesh files of a folder by their stems, in natural order; of one stem the first of ``endings``.

    A link to nowhere counts: the check should say that it is one.
    """
    found: dict[str, Path] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        ending = path.suffix.lower()
        if ending not in endings or path.name.startswith(".") or path.is_dir():
            continue
        old = found.get(path.stem)
        if old is None or endings.index(ending) < endings.index(old.suffix.lower()):
            found[path.stem] = path
    return {stem: found[stem] for stem in sorted(found, key=natural_key)}


def vertex_count(path: Path) -> int:
    """Number of vertices of a mesh file, from its header where it has one.

    Raises:
        MeshError: the file is missing, or is no mesh of its ending.
    """
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror or error})") from error
    match = _OFF_HEADER.match(head) if path.suffix.lower() == ".off" else None
    if path.suffix.lower() == ".ply" and head.startswith(b"ply"):
        match = re.search(rb"^element\s+vertex\s+(\d+)", head, re.MULTILINE)
    if match:
        return int(match[1])
    if path.suffix.lower() == ".obj":
        count = sum(line.startswith((b"v ", b"v\t")) for line in path.read_bytes().splitlines())
        if count:
            return count
    if path.suffix.lower() == ".vert" and path.with_suffix(".tri").exists():
        count = sum(bool(line.strip()) for line in path.read_bytes().splitlines())
        if count:
            return count
    return load_mesh(path).n_verts


def look_at_mesh(path: Path, full: bool = False) -> str | None:
    """What is wrong with a mesh file, or None.

    Of an OFF file that has the lines its header promises, and nothing in them but numbers, the numbers are not read
    (that takes most of the time) unless ``full``; every other file is loaded.
    """
    try:
        quick = not full and path.suffix.lower() == ".off" and path.is_file()
        if not (quick and _off_adds_up(path.read_bytes())):
            load_mesh(path)
    except (MeshError, OSError) as error:
        return str(error)
    return None


def _off_adds_up(data: bytes) -> bool:
    """Whether an OFF file consists of a header, as many lines as it declares, and numbers."""
    match = _OFF_HEADER.match(data)
    if match is None or int(match[1]) == 0 or int(match[2]) == 0:
        return False
    body = data[match.end() :].rstrip()
    return body.count(b"\n") + 1 == int(match[1]) + int(match[2]) and not body.translate(None, _NUMBER_BYTES)


def raw_faces(path: Path) -> np.ndarray:
    """Triangles with the ids that the file has, whatever its index base."""
    return READERS[path.suffix.lower()][0](path)[1]
