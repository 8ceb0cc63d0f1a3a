"""One shape of a set as the dictionary that learned pipelines read.

========================================  =================================================  ==========
key                                       what                                               asked by
========================================  =================================================  ==========
``name, verts, faces``                    text; ``(V, 3)``; ``(F, 3)`` int64                 always
``mass, L``                               ``(V,)``; ``(V, V)`` sparse, positive semidefinite operators
``evals, evecs, evecs_trans``             ``(K,)``; ``(V, K)``; ``(K, V)``                   basis
``gradX, gradY``                          ``(V, V)`` sparse, in a tangent frame              gradients
``dist``                                  ``(V, V)`` geodesic distances                      distances
``corr``                                  ``(S,)`` int64, see :func:`template_corr`          truth
``group, evals_even, evecs_even,``        ``(G, V)`` int64; bases of the symmetric functions symmetry
``evals_odd, evecs_odd``                  and of the rest, ``(K+,), (V, K+)``
========================================  =================================================  ==========

The keys are those of the ULRSSM family of data sets (Cao et al. 2023) with those of symmetry added; ``L`` and the
gradients are what diffusion-net reads.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.data.base import ShapeSet, TruthError
from torchqm.geometry.check import MeshError
from torchqm.geometry.geodesic import distances
from torchqm.geometry.gradient import vertex_gradient
from torchqm.geometry.laplacian import laplacian
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.cache import cached_basis
from torchqm.symmetry.basis import symmetrized_basis
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["ITEM_KEYS", "KEY_GROUPS", "ItemOptions", "make_item", "template_corr"]

KEY_GROUPS: dict[str, tuple[str, ...]] = {
    "shape": ("name", "verts", "faces"),
    "operators": ("mass", "L"),
    "basis": ("evals", "evecs", "evecs_trans"),
    "gradients": ("gradX", "gradY"),
    "distances": ("dist",),
    "truth": ("corr",),
    "symmetry": ("group", "evals_even", "evecs_even", "evals_odd", "evecs_odd"),
}
"""Keys by what they cost."""

ITEM_KEYS = tuple(key for keys in KEY_GROUPS.values() for key in keys)
"""All keys of an item, in their order."""

_ROW_BYTES = 2**27  # of geodesic distances computed at a time, in float64


@dataclass(frozen=True)
class ItemOptions:
    """What is made of a shape.

    Args:
        keys: single keys of :data:`ITEM_KEYS` or names of :data:`KEY_GROUPS`; ``name``, ``verts`` and ``faces`` are
            always made.
        k: number of eigenpairs.
        laplacian: which Laplacian, see :func:`torchqm.geometry.laplacian.laplacian`.
        unit_area: move the mesh to its centroid and scale it to total area 1, as the pipeline does; ``dist`` is then an
            error / sqrt(area).
        dtype: of all real numbers; what layers with float32 weights need is ``torch.float32``. Everything is computed
            in float64.
        cache_dir: folder of the spectral cache, see :func:`torchqm.spectral.cache.cached_basis`.
        whole_clusters: return fewer than ``k`` functions where the cut would go through a cluster of equal eigenvalues.
        basis: what computes the basis of a mesh (in the mesh's own units) instead of the cache.
        geodesics: solver of ``dist``, see :func:`torchqm.geometry.geodesic.distances`.
        max_dist_bytes: largest ``dist`` that may be made of one shape.

    Raises:
        ValueError: an unknown key, a ``k`` below 1, or a ``dtype`` that is no real type.

    Example:
        >>> ItemOptions(keys=("basis", "mass")).wanted
        ('name', 'verts', 'faces', 'mass', 'evals', 'evecs', 'evecs_trans')
    """

    keys: tuple[str, ...] = ("operators", "basis")
    k: int = 200
    laplacian: str = "auto"
    unit_area: bool = True
    dtype: torch.dtype = torch.float64
    cache_dir: str | Path | None = None
    whole_clusters: bool = False
    basis: Callable[[Mesh, int], SpectralBasis] | None = None
    geodesics: str = "fast_marching"
    max_dist_bytes: float = 4 * 2.0**30

    def __post_init__(self) -> None:
        unknown = [key for key in self.keys if key not in ITEM_KEYS and key not in KEY_GROUPS]
        if unknown:
            raise ValueError(
                f"keys: unknown {', '.join(map(repr, unknown))}; allowed are {', '.join(ITEM_KEYS)} and the groups "
                f"{', '.join(KEY_GROUPS)}"
            )
        if self.k < 1:
            raise ValueError(f"k: given {self.k}; at least 1 eigenpair is needed")
        if not self.dtype.is_floating_point:
            raise ValueError(f"dtype: given {self.dtype}; allowed are torch.float64, torch.float32 and the like")

    @property
    def wanted(self) -> tuple[str, ...]:
        """The keys of an item made with these options, in the order of :data:`ITEM_KEYS`."""
        asked = {*KEY_GROUPS["shape"], *(key for word in self.keys for key in KEY_GROUPS.get(word, (word,)))}
        return tuple(key for key in ITEM_KEYS if key in asked)


def make_item(shapes: ShapeSet, name: str, options: ItemOptions | None = None) -> dict[str, Any]:
    """One shape as a dictionary with the keys that were asked for.

    Where the set knows no symmetry of the shape, ``group`` is the identity alone, the even functions are all and there
    are no odd ones.

    Args:
        shapes: the set.
        name: one of its shapes.
        options: what to make; mass, Laplacian and 200 eigenpairs if not given.

    Returns:
        The keys ``options.wanted``, in their order; real numbers have ``options.dtype``.

    Raises:
        MeshError: the mesh cannot be read, or has no area.
        TruthError: ``corr`` is asked for and the set has no shared template for this shape.
        ValueError: no such shape, or a ``dist`` larger than allowed.

    Example:
        >>> from torchqm.data.synthetic_set import SyntheticShapes
        >>> shapes = SyntheticShapes("synthetic:kinds=ellipsoid;verts=500;triangulation=shared")
        >>> item = make_item(shapes, "ellipsoid-0-pose1", ItemOptions(keys=("basis", "symmetry"), k=20))
        >>> item["evecs"].shape, item["group"].shape[0], item["evals_even"].shape
        (torch.Size([490, 20]), 8, torch.Size([5]))
    """
    options = options or ItemOptions()
    wanted = set(options.wanted)
    given = shapes.mesh(name)
    if not 0 < given.area < float("inf"):
        raise MeshError(f"{given.label}: the surface has area {given.area:g}; a positive one is needed")
    mesh = given.normalized() if options.unit_area else given
    item: dict[str, Any] = {"name": name, "verts": mesh.verts, "faces": mesh.faces}
    basis = _basis(given, options, wanted)
    if basis is not None:
        item |= {"mass": basis.mass, "evals": basis.evals, "evecs": basis.evecs, "evecs_trans": basis.evecs_trans}
    if "L" in wanted or ("mass" in wanted and basis is None):
        # What "auto" chose for the eigenpairs holds for the matrix too.
        operator = laplacian(mesh, getattr(getattr(basis, "report", None), "kind", options.laplacian))
        item |= {"mass": item.get("mass", operator.mass), "L": operator.stiffness}
    if wanted & set(KEY_GROUPS["gradients"]):
        gradient = vertex_gradient(mesh)
        item |= {"gradX": gradient.grad_x, "gradY": gradient.grad_y}
    if wanted & set(KEY_GROUPS["symmetry"]):
        item |= _symmetry(shapes, name, mesh, basis)
    if "dist" in wanted:
        item["dist"] = _all_distances(mesh, options)
    if "corr" in wanted:
        item["corr"] = template_corr(shapes, name)
    return {key: _cast(item[key], options.dtype) for key in options.wanted}


def template_corr(shapes: ShapeSet, name: str) -> Int[Tensor, " S"]:
    """For each point of a template that a class shares, the vertex of this shape (0-based).

    So ``corr_x[i]`` and ``corr_y[i]`` correspond, and the error of a point map ``p2p_yx`` is
    ``dist_x[corr_x, p2p_yx[corr_y]]``, as in the ULRSSM family. Where the set has a file for each shape (``.vts``) that
    is its content, where the vertex ids of a class agree it is ``0..V-1``, elsewhere the template is the first shape of
    the class. Of a true point inside a face the corner with the largest weight is taken.

    Args:
        shapes: the set.
        name: one of its shapes.

    Raises:
        TruthError: the set has no truth for it, or truth for each pair at other points, so that nothing is shared.
    """
    cls = shapes.shape_class(name)
    members = [other for other in shapes.names if shapes.shape_class(other) == cls]
    template, second = members[0], members[min(1, len(members) - 1)]
    rows = shapes.truth(template, second).at
    if name == template:
        return rows
    truth = shapes.truth(template, name)
    if not torch.equal(truth.at, rows):
        raise TruthError(
            f"{shapes.root}: no template shared by {cls!r}: the truth from {template} to {second} and to {name} is at "
            "different points; ask for pairs, whose 'corr' needs no template"
        )
    return truth.vertices


def _basis(mesh: Mesh, options: ItemOptions, wanted: set[str]) -> SpectralBasis | None:
    """Eigenpairs, in the units of the item, where something needs them.

    They are computed of the mesh as it is in the set: its content is the cache's key.
    """
    if not wanted & {*KEY_GROUPS["basis"], *KEY_GROUPS["symmetry"]} - {"group"}:
        return None
    if options.basis is not None:
        basis = options.basis(mesh, options.k)
    else:
        basis = cached_basis(mesh, options.k, options.laplacian, options.cache_dir, options.whole_clusters)
    return basis.scaled(mesh.area**-0.5) if options.unit_area else basis


def _symmetry(shapes: ShapeSet, name: str, mesh: Mesh, basis: SpectralBasis | None) -> dict[str, Tensor]:
    group = shapes.symmetry(name) or SymmetryGroup.trivial(mesh.n_verts)
    if basis is None:
        return {"group": group.maps}
    split = symmetrized_basis(basis, group)
    return {
        "group": group.maps,
        "evals_even": split.even.evals,
        "evecs_even": split.even.evecs,
        "evals_odd": split.odd.evals,
        "evecs_odd": split.odd.evecs,
    }


def _all_distances(mesh: Mesh, options: ItemOptions) -> Float[Tensor, "V V"]:
    n = mesh.n_verts
    size = n * n * options.dtype.itemsize
    if size > options.max_dist_bytes:
        raise ValueError(
            f"dist: {mesh.label} has {n} vertices, so its distances take {size / 2**30:.1f} GiB; max_dist_bytes allows "
            f"{options.max_dist_bytes / 2**30:.1f}. Errors need the rows of the true points only: "
            "torchqm.evaluate.geodesic_errors"
        )
    out = torch.empty(n, n, dtype=options.dtype)
    step = max(1, _ROW_BYTES // (8 * n))
    for first in range(0, n, step):
        rows = torch.arange(first, min(first + step, n))
        out[rows] = distances(mesh, rows, options.geodesics).to(options.dtype)
    return out


def _cast(value: Any, dtype: torch.dtype) -> Any:
    return value.to(dtype) if isinstance(value, Tensor) and value.is_floating_point() else value
