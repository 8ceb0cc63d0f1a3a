"""What can be said of a map without any truth: is it one-to-one, onto, smooth, and nearly an isometry.

None of these tells the direct map from the mirrored one, and each alone can be fooled (a map to a single point is
perfectly smooth), so read them together. Maps run from x to y; the functional map that belongs to ``p2p_xy`` is its
pull-back, which takes functions on y to functions on x.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.evaluate.distances import pair_distances, solver_used
from torchqm.evaluate.metrics import TruthDistances, geodesic_errors
from torchqm.fmap.convert import p2p_to_fmap
from torchqm.fmap.energy import orthogonality_energy
from torchqm.geometry.check import clean_faces
from torchqm.geometry.laplacian import cotan_stiffness
from torchqm.geometry.mesh import Mesh
from torchqm.matching.quality import commutator_norm
from torchqm.spectral.basis import SpectralBasis

__all__ = [
    "LabelFree",
    "bijectivity",
    "commutativity",
    "coverage",
    "dirichlet_energy",
    "label_free",
    "orthogonality",
]


@dataclass(frozen=True)
class LabelFree:
    """The measures of one map; those for which something was not given are None.

    Args:
        coverage: see :func:`coverage`; 1 is best.
        dirichlet_energy: see :func:`dirichlet_energy`; 1 for an isometry.
        bijectivity: see :func:`bijectivity`; 0 is best; needs the map back.
        orthogonality: see :func:`orthogonality`; 0 for an isometry; needs both bases.
        commutativity: see :func:`commutativity`; 0 for an isometry; needs both bases.
        k: number of basis functions a side behind the last two.
        solver: the geodesic solver behind ``bijectivity``.
    """

    coverage: float
    dirichlet_energy: float
    bijectivity: float | None = None
    orthogonality: float | None = None
    commutativity: float | None = None
    k: int | None = None
    solver: str | None = None

    def to_row(self) -> dict[str, float | int | str | None]:
        """The measures as columns of a table of pairs."""
        row = asdict(self)
        return row | {"label_free_k": row.pop("k"), "label_free_solver": row.pop("solver")}


def label_free(
    mesh_x: Mesh,
    mesh_y: Mesh,
    p2p_xy: Int[Tensor, " Vx"],
    p2p_yx: Int[Tensor, " Vy"] | None = None,
    basis_x: SpectralBasis | None = None,
    basis_y: SpectralBasis | None = None,
    k: int = 50,
    at: Int[Tensor, " S"] | None = None,
    method: str = "fast_marching",
    distances: TruthDistances | None = None,
    cache_dir: str | Path | None = None,
) -> LabelFree:
    """All the measures of this module that the arguments allow.

    Args:
        mesh_x: the shape that is mapped.
        mesh_y: the shape that it is mapped to.
        p2p_xy: ``(Vx,)`` vertex of y for each vertex of x.
        p2p_yx: ``(Vy,)`` the map back, for :func:`bijectivity`.
        basis_x: Laplacian basis of x.
        basis_y: Laplacian basis of y.
        k: number of basis functions of each, at most.
        at: ``(S,)`` vertices of x at which bijectivity is measured; all of them if left out (slow on large shapes).
        method: geodesic solver on x.
        distances: rows on x from the vertices ``at``, if at hand.
        cache_dir: see :func:`~torchqm.evaluate.distances.pair_distances`.

    Raises:
        ValueError: naming the map that does not fit its shapes.
    """
    out = LabelFree(coverage(mesh_y, p2p_xy), dirichlet_energy(mesh_x, mesh_y, p2p_xy))
    changes: dict[str, float | int | str] = {}
    if p2p_yx is not None:
        changes["bijectivity"] = bijectivity(mesh_x, p2p_xy, p2p_yx, at, method, distances, cache_dir)
        changes["solver"] = solver_used(mesh_x, method) if distances is None else distances.method
    if basis_x is not None and basis_y is not None:
        k = min(k, basis_x.k, basis_y.k)
        basis_x, basis_y = basis_x.truncate(k), basis_y.truncate(k)
        fmap_yx = p2p_to_fmap(p2p_xy, basis_y, basis_x)
        changes["orthogonality"] = orthogonality(fmap_yx)
        changes["commutativity"] = commutativity(fmap_yx, basis_y.evals, basis_x.evals)
        changes["k"] = k
    return LabelFree(**(asdict(out) | changes))


def bijectivity(
    mesh_x: Mesh,
    p2p_xy: Int[Tensor, " Vx"],
    p2p_yx: Int[Tensor, " Vy"],
    at: Int[Tensor, " S"] | None = None,
    method: str = "fast_marching",
    distances: TruthDistances | None = None,
    cache_dir: str | Path | None = None,
) -> float:
    """How far a point of x is from where it started after going to y and back; 0 where the maps undo each other.

    ``mean_x d_X(x, T_yx(T_xy(x))) / sqrt(area(X))``, over the area of x, or over the points ``at``. It is not
    symmetric: a map of few vertices into many can be undone exactly, one of the many into the few cannot.

    Args:
        mesh_x: the shape on which the distance is measured.
        p2p_xy: ``(Vx,)`` vertex of y for each vertex of x.
        p2p_yx: ``(Vy,)`` vertex of x for each vertex of y.
        at: ``(S,)`` vertices of x, each counting alike; all of them, weighted by their areas, if left out.
        method: geodesic solver; ignored if ``distances`` is given.
        distances: rows on x from the vertices ``at``.
        cache_dir: see :func:`~torchqm.evaluate.distances.pair_distances`.

    Raises:
        ValueError: if a map does not fit, or x has no area.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]])  # area 1
        >>> turn, back, stay = torch.tensor([1, 2, 0]), torch.tensor([2, 0, 1]), torch.tensor([0, 1, 2])
        >>> bijectivity(mesh, turn, back), bijectivity(mesh, torch.tensor([0, 0, 2]), stay, at=stay[:2])
        (0.0, 1.0)

    References:
        Ren, Poulenard, Wonka, Ovsjanikov, "Continuous and orientation-preserving correspondences via functional maps",
        2018, where bijectivity and coverage are measured beside the error.
    """
    _check_map("p2p_yx", p2p_yx, len(p2p_yx), mesh_x.n_verts)
    _check_map("p2p_xy", p2p_xy, mesh_x.n_verts, len(p2p_yx))
    if at is not None and (len(at) == 0 or not 0 <= int(at.min()) <= int(at.max()) < mesh_x.n_verts):
        given = f"{int(at.min())}..{int(at.max())}" if len(at) else "none"
        raise ValueError(f"at: expected vertices in 0..{mesh_x.n_verts - 1}, got {given}")
    weights = mesh_x.vertex_areas if at is None else None
    at = torch.arange(mesh_x.n_verts) if at is None else at
    if weights is not None:  # a vertex of no face has no part in the area, and is infinitely far from the others
        at = at[weights > 0]
        weights = weights[at]
    ends = p2p_yx[p2p_xy]
    if distances is not None:
        back = geodesic_errors(mesh_x, ends, at, at, distances=distances)
    else:  # points that come back to where they were, most of them in a good map, need no solve
        back = pair_distances(mesh_x, at, ends[at], method, cache_dir) / _area(mesh_x) ** 0.5
    return float(back.mean() if weights is None else (back * weights).sum() / weights.sum())


def coverage(mesh_y: Mesh, p2p_xy: Int[Tensor, " Vx"]) -> float:
    """Share of the area of y that the map reaches: ``sum of A_y over y in T(X) / area(Y)``; 1 where it is onto.

    Areas are those of vertices, so x with fewer vertices than y cannot reach all of it: compare maps of one pair only.

    Args:
        mesh_y: the shape that is mapped to.
        p2p_xy: ``(Vx,)`` vertex of y for each vertex of x.

    Raises:
        ValueError: if an entry is no vertex of y, or y has no area.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> round(coverage(mesh, torch.tensor([0, 0, 2])), 6)
        0.666667
    """
    _check_map("p2p_xy", p2p_xy, len(p2p_xy), mesh_y.n_verts)
    return float(mesh_y.vertex_areas[p2p_xy.unique()].sum() / _area(mesh_y))


def dirichlet_energy(mesh_x: Mesh, mesh_y: Mesh, p2p_xy: Int[Tensor, " Vx"]) -> float:
    """How much the map stretches: ``1/2 int_X |grad T|^2 / area(Y) = tr(Z^T L_x Z) / (2 area(Y))``, ``Z = verts_y[T]``.

    The map is taken as linear on each triangle of x, its image as straight in space. It is 1 where triangles keep
    their size and angles (the identity of any mesh), 0 where all goes to one point, and never below the area of the
    image over that of y, which a conformal map attains: beside a coverage near 1 the excess over 1 is distortion and
    tearing. The scale of neither shape matters.

    Args:
        mesh_x: the shape that is mapped; flat triangles add nothing.
        mesh_y: the shape that it is mapped to.
        p2p_xy: ``(Vx,)`` vertex of y for each vertex of x.

    Raises:
        ValueError: if the map does not fit, or y has no area.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> wide = mesh.moved(mesh.verts * torch.tensor([3.0, 1.0, 1.0], dtype=torch.float64))
        >>> [round(dirichlet_energy(mesh, y, torch.arange(3)), 6) for y in (mesh, wide)]  # (9 + 1) / 2 / 3
        [1.0, 1.666667]

    References:
        Pinkall, Polthier, "Computing discrete minimal surfaces and their conjugates", 1993; Ezuz, Solomon, Ben-Chen,
        "Reversible harmonic maps between discrete surfaces", 2019 (as an energy of maps between shapes).
    """
    _check_map("p2p_xy", p2p_xy, mesh_x.n_verts, mesh_y.n_verts)
    unit = _area(mesh_y) ** 0.5
    images = (mesh_y.verts[p2p_xy] - mesh_y.verts[p2p_xy[:1]]) / unit
    stiffness = cotan_stiffness(mesh_x.verts, clean_faces(mesh_x))
    return float((images * torch.sparse.mm(stiffness, images)).sum()) / 2


def orthogonality(fmap_xy: Float[Tensor, "Ky Kx"]) -> float:
    """``|| C^T C - I ||_F^2 / K`` over the smaller side, K its size; 0 where the map keeps areas (locally).

    Args:
        fmap_xy: takes functions on x to functions on y, in orthonormal bases.

    Example:
        >>> orthogonality(torch.tensor([[0.0, 1.0], [1.0, 0.0]])), orthogonality(torch.tensor([[1.0, 0.0], [0.0, 0.0]]))
        (0.0, 0.5)

    References:
        Paper, Lemma 4.1 ii.
    """
    return float(orthogonality_energy(fmap_xy)) / min(fmap_xy.shape)


def commutativity(
    fmap_xy: Float[Tensor, "Ky Kx"], evals_x: Float[Tensor, " Kx"], evals_y: Float[Tensor, " Ky"]
) -> float:
    """``|| C D_x - D_y C ||_F / (|| C D_x ||_F + || D_y C ||_F)``, D the Laplacians; 0 for an isometry, at most 1.

    Args:
        fmap_xy: takes functions on x to functions on y, in Laplacian eigenbases.
        evals_x: ``(Kx,)`` eigenvalues of x; a common scale of both sides does not matter.
        evals_y: ``(Ky,)`` eigenvalues of y.

    Example:
        >>> evals = torch.tensor([0.0, 2.0])
        >>> commutativity(torch.eye(2), evals, evals), round(commutativity(torch.eye(2).flip(0), evals, evals), 6)
        (0.0, 0.707107)

    References:
        Paper, section 4.3.
    """
    return commutator_norm(fmap_xy, evals_x, evals_y)


def _check_map(name: str, p2p: Int[Tensor, " N"], n_from: int, n_to: int) -> None:
    if len(p2p) != n_from or n_from == 0:
        raise ValueError(f"{name}: expected an entry for each of the {n_from} vertices it starts at, got {len(p2p)}")
    if not 0 <= int(p2p.min()) <= int(p2p.max()) < n_to:
        raise ValueError(f"{name}: entries must lie in 0..{n_to - 1}, got {int(p2p.min())}..{int(p2p.max())}")


def _area(mesh: Mesh) -> float:
    if not 0 < mesh.area < float("inf"):
        raise ValueError(f"mesh: {mesh.label} has area {mesh.area}; the measure is undefined")
    return mesh.area
