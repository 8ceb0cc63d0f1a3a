"""Reading the operator cache of diffusion-net, ``<sha1(verts, faces)>_<i>.npz``, as its users have it on disk.

Its arrays are in single precision and in the units of the vertices that its user gave, often moved and scaled ones
(``normalize_positions``). What is taken from a file are the eigenfunctions; whether they are eigenfunctions of *this*
mesh is checked against its own Laplacian, and that gives them the accuracy back: they are made orthonormal in the
mesh's own mass in double precision, and the Laplacian is diagonalised among them (Rayleigh-Ritz), so that the error of
an eigenvalue is the square of the error of its function.

References:
    N. Sharp, S. Attaiki, K. Crane, M. Ovsjanikov, "DiffusionNet: Discretization Agnostic Learning on Surfaces", 2022;
    ``get_operators`` and ``hash_arrays`` of https://github.com/nmwsharp/diffusion-net.
"""

import hashlib
import os
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from torchqm.geometry.laplacian import Laplacian, laplacian, to_scipy
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.eigen import fix_signs

__all__ = ["DiffusionNetBasis", "DiffusionNetError", "diffusion_net_files", "read_diffusion_net"]

MAX_RESIDUAL = 2e-2
"""Relative residual ``|| W phi - lambda M phi || / lambda`` up to which a function counts as one of the Laplacian's.

Rounding to single precision leaves about 1e-7 V / lambda: 2e-4 on 28k vertices. A function of another Laplacian of the
same mesh (robust for cotangent) has 0.1 and more where the two differ at all."""

MAX_GRAM_ERROR = 1e-3
"""Largest entry of ``Phi^T M Phi / c - I``; single precision leaves 1e-6."""

_NAME = re.compile(r"[0-9a-f]{40}_\d+\.npz")
_ROUNDING = 4e-6  # of coordinates that were moved and scaled in single precision, relative to the largest


class DiffusionNetError(ValueError):
    """A file of diffusion-net that cannot be used for a mesh; the message names it and says why."""


@dataclass(frozen=True, eq=False)
class DiffusionNetBasis:
    """Eigenpairs taken over from a file.

    Args:
        basis: in double precision and the units of the mesh.
        kind: the Laplacian whose eigenpairs they are, ``cotan`` or ``robust``.
        reason: why that one.
    """

    basis: SpectralBasis
    kind: str
    reason: str


def diffusion_net_files(folder: str | Path, mesh: Mesh) -> list[Path]:
    """The files of a folder that are of this mesh, best first.

    First those that have the name diffusion-net would give: the SHA-1 of the bytes of ``verts`` and ``faces``, for
    single and double precision, ids of 32 and 64 bits. Then those that hold the same triangles and the same vertices
    up to a translation and a scale.

    Args:
        folder: where to look; need not be there.
        mesh: the mesh as it was loaded.

    Returns:
        Paths; a file that cannot be read is among them only if its name is right.
    """
    try:
        present = {entry.name: entry for entry in os.scandir(folder) if _NAME.fullmatch(entry.name)}
    except OSError:
        return []
    if not present:
        return []
    verts, faces = mesh.numpy()
    sums = [
        hashlib.sha1(verts.astype(v).tobytes() + faces.astype(f).tobytes()).hexdigest()
        for v in (np.float32, np.float64)
        for f in (np.int64, np.int32)
    ]
    named = [name for digest in sums for name in sorted(present) if name.startswith(digest)]
    digest = _faces_digest(faces)
    for name in sorted(set(present) - set(named)):
        stat = present[name].stat()
        path = Path(folder) / name
        if _file_faces(str(path), stat.st_mtime_ns, stat.st_size) == digest:
            theirs = _load(path, "verts")
            if theirs is not None and _same_verts(verts, theirs):
                named.append(name)
    return [Path(folder) / name for name in named]


def read_diffusion_net(path: str | Path, mesh: Mesh, kind: str = "auto") -> DiffusionNetBasis:
    """The eigenpairs of a file, checked against the mesh and converted.

    Args:
        path: the file.
        mesh: the mesh it should be of.
        kind: the Laplacian wanted. ``auto`` takes cotangent or robust eigenpairs, whichever the file holds, unless the
            mesh needs the robust Laplacian.

    Returns:
        All functions of the file, orthonormal in the mesh's own mass.

    Raises:
        DiffusionNetError: the file is damaged, of another mesh or of another Laplacian, or its functions are not
            orthonormal.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            verts, faces, evals, evecs = (file[name] for name in ("verts", "faces", "evals", "evecs"))
    except Exception as error:  # a damaged file can raise anything
        raise DiffusionNetError(f"{path}: cannot be read ({error})") from error
    if faces.shape != tuple(mesh.faces.shape) or not np.array_equal(faces, mesh.numpy()[1]):
        raise DiffusionNetError(f"{path}: its faces are not those of {mesh.label}")
    if not _same_verts(mesh.numpy()[0], verts):
        raise DiffusionNetError(f"{path}: its verts are not those of {mesh.label}")
    if evals.ndim != 1 or len(evals) == 0 or evecs.shape != (mesh.n_verts, len(evals)):
        raise DiffusionNetError(
            f"{path}: evals {evals.shape} and evecs {evecs.shape} do not fit {mesh.n_verts} vertices"
        )
    operator = laplacian(mesh, kind)
    functions = torch.from_numpy(np.ascontiguousarray(evecs, dtype=np.float64))
    try:
        return DiffusionNetBasis(_converted(functions, operator), operator.kind, operator.reason)
    except ValueError as error:
        if kind != "auto" or operator.kind != "cotan":
            raise DiffusionNetError(f"{path}: {error}") from error
        first = error
    try:
        basis = _converted(functions, laplacian(mesh, "robust"))
    except ValueError:
        raise DiffusionNetError(f"{path}: {first}") from first
    return DiffusionNetBasis(basis, "robust", f"the eigenpairs of {path.name} are of this one")


def _converted(functions: torch.Tensor, operator: Laplacian) -> SpectralBasis:
    """Make functions orthonormal and diagonalise the Laplacian among them, unless they are not its eigenfunctions."""
    used = operator.mass > 0
    functions = torch.where(used[:, None], functions, 0.0)
    gram = functions.T @ (operator.mass[:, None] * functions)
    # Their scale is that of the file's own mass, which may be in another unit, or normalised; only the shape counts.
    size = float(gram.diagonal().mean())
    if not (size > 0 and np.isfinite(size)):
        raise ValueError("its evecs are zero or not finite")
    off = float((gram / size - torch.eye(len(gram), dtype=gram.dtype)).abs().max())
    if not off <= MAX_GRAM_ERROR:
        raise ValueError(f"its evecs are not orthonormal in the {operator.kind} mass (off by {off:.2g})")
    factor = torch.linalg.cholesky(gram)
    functions = torch.linalg.solve_triangular(factor, functions.T, upper=False).T
    image = torch.from_numpy(to_scipy(operator.stiffness) @ functions.numpy())
    evals, rotation = torch.linalg.eigh(functions.T @ image)
    evals, functions, image = evals.clamp_min(0.0), functions @ rotation, image @ rotation
    # Relative to the first eigenvalue that is none of the zeros (one a component).
    first = float(evals[evals > 1e-6 * evals[-1]][:1].sum()) or 1.0
    if not float((functions.T @ operator.mass).square().sum() / operator.mass.sum()) > 1 - 1e-3:
        raise ValueError("the constant function is not among its evecs")
    rest = torch.where(used[:, None], image - operator.mass[:, None] * functions * evals, 0.0)
    norms = (rest.square() / torch.where(used, operator.mass, 1.0)[:, None]).sum(0).sqrt()
    worst = float((norms / evals.clamp_min(first)).max())
    if not worst <= MAX_RESIDUAL:
        raise ValueError(f"its evecs are not eigenfunctions of the {operator.kind} Laplacian (residual {worst:.2g})")
    return SpectralBasis(evals, fix_signs(functions).contiguous(), operator.mass)


def _same_verts(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Whether two sets of positions are equal up to translation, scale and the rounding of single precision."""
    if theirs.shape != ours.shape or theirs.dtype.kind != "f":
        return False
    theirs = theirs.astype(np.float64)
    size = float(np.abs(ours).max()) or 1.0
    a, b = ours / size, theirs / (float(np.abs(theirs).max()) or 1.0)
    a, b = a - a.mean(0), b - b.mean(0)
    scale = float((a * b).sum() / max(float((a * a).sum()), 1e-300))
    return scale > 0 and bool(np.abs(scale * a - b).max() <= _ROUNDING * max(1.0, scale))


def _faces_digest(faces: np.ndarray) -> str:
    return hashlib.sha1(np.ascontiguousarray(faces, dtype=np.int64).data).hexdigest()


@lru_cache(maxsize=4096)
def _file_faces(path: str, mtime: int, size: int) -> str | None:
    """Digest of the faces in a file, kept as long as the file is the same; None if it cannot be read."""
    faces = _load(Path(path), "faces")
    return None if faces is None else _faces_digest(faces)


def _load(path: Path, name: str) -> np.ndarray | None:
    """One array of a file, without reading the others."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return np.asarray(file[name])
    except Exception:  # a damaged or foreign file; whose it was, nobody can say
        return None
