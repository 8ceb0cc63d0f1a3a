"""Reading and writing meshes: OFF, OBJ, PLY, STL and the two forms of TOSCA; vertex ids stay as in the file."""

import difflib
from pathlib import Path

import numpy as np

from torchqm.geometry.check import MeshError, check_arrays, weld
from torchqm.geometry.files import write_whole
from torchqm.geometry.formats import READERS
from torchqm.geometry.mesh import Mesh

__all__ = ["READABLE", "WRITABLE", "load_mesh", "save_mesh"]

READABLE = tuple(READERS)
"""File endings that :func:`load_mesh` reads."""
WRITABLE = (".off", ".obj", ".ply")
"""File endings that :func:`save_mesh` writes."""


def load_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh.

    Vertices keep their ids, unreferenced ones too. Polygons become fans of triangles around their first corner. STL has
    no shared vertices, so there, and only there, equal positions become one vertex, with ids in the order of first
    appearance. ``.mat`` (``surface.X, Y, Z, TRIV``) and ``.vert`` + ``.tri`` count vertices from 1 unless an id 0
    occurs; of a ``.vert``/``.tri`` pair either file or the common stem is given.

    Args:
        path: a file ending in ``.off``, ``.obj``, ``.ply``, ``.stl``, ``.mat``, ``.vert`` or ``.tri``.

    Returns:
        The mesh, named by the file's stem; :func:`~torchqm.geometry.check.check_mesh` judges its topology.

    Raises:
        MeshError: the file is missing, a folder, empty, truncated or no mesh; its ending is unknown; a face refers to a
            vertex that does not exist; a coordinate is NaN or infinite; there are no vertices or no faces.

    Example:
        >>> load_mesh("nowhere/cat0.off")
        Traceback (most recent call last):
        torchqm.geometry.check.MeshError: nowhere/cat0.off: no such file (there is no folder nowhere either)
    """
    path = Path(path)
    if not path.exists() and path.with_name(path.name + ".vert").exists():
        path = path.with_name(path.name + ".vert")
    _check_file(path)
    reader, base = READERS[path.suffix.lower()]
    try:
        verts, faces = reader(path)
    except MeshError:
        raise
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror or error})") from error
    if base and len(faces) and faces.min() > 0:
        faces = faces - base
    check_arrays(verts, faces, str(path))
    mesh = Mesh.from_arrays(verts, faces, path.stem, path)
    return weld(mesh)[0] if path.suffix.lower() == ".stl" else mesh


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh so that the file appears whole or not at all; reading it back gives exactly the same numbers.

    Args:
        mesh: the mesh.
        path: a file ending in ``.off``, ``.obj`` or ``.ply`` (binary, double precision); an old file is replaced.

    Raises:
        MeshError: another ending, or the place cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITABLE:
        raise MeshError(
            f"{path}: cannot write {path.suffix or 'a file without ending'}; supported are {', '.join(WRITABLE)}"
        )
    content = {".off": _off_bytes, ".obj": _obj_bytes, ".ply": _ply_bytes}[path.suffix.lower()](*mesh.numpy())
    try:
        write_whole(path, lambda file: file.write(content))
    except OSError as error:
        raise MeshError(f"{path}: cannot be written ({error.strerror or error})") from error


def _check_file(path: Path) -> None:
    """Everything that can be said about a path before its content is looked at."""
    if path.is_dir():
        raise MeshError(f"{path}: is a folder, not a mesh file")
    if not path.exists():
        if not path.parent.is_dir():
            raise MeshError(f"{path}: no such file (there is no folder {path.parent} either)")
        known = [p.name for p in path.parent.iterdir() if p.suffix.lower() in READABLE]
        close = difflib.get_close_matches(path.name, known, n=3, cutoff=0.6)
        hint = f"; did you mean {' or '.join(close)}?" if close else ""
        raise MeshError(f"{path}: no such file{hint}")
    if path.suffix.lower() not in READABLE:
        ending = f"unknown ending {path.suffix!r}" if path.suffix else "no file ending"
        raise MeshError(f"{path}: {ending}; supported are {', '.join(READABLE)}")
    if path.stat().st_size == 0:
        raise MeshError(f"{path}: the file is empty")


def _off_bytes(verts: np.ndarray, faces: np.ndarray) -> bytes:
    rows = [f"OFF\n{len(verts)} {len(faces)} 0"]
    rows += [f"{x!r} {y!r} {z!r}" for x, y, z in verts.tolist()]  # repr: the shortest text that reads back exactly
    rows += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return ("\n".join(rows) + "\n").encode()


def _obj_bytes(verts: np.ndarray, faces: np.ndarray) -> bytes:
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in verts.tolist()]
    rows += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return ("\n".join(rows) + "\n").encode()


def _ply_bytes(verts: np.ndarray, faces: np.ndarray) -> bytes:
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(verts)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    table = np.empty(len(faces), dtype=[("n", "u1"), ("ids", "<i4", 3)])
    table["n"], table["ids"] = 3, faces
    return header.encode() + verts.astype("<f8").tobytes() + table.tobytes()
