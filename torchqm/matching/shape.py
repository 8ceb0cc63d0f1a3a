"""A mesh made ready for matching: unit area, eigenbasis, samples; computed once a shape and used by every pair."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.surface_search import SurfaceSearch
from torchqm.fmap.threads import in_parallel, one_thread
from torchqm.geometry.check import MeshReport, clean_faces, inspect_mesh, orient_faces
from torchqm.geometry.laplacian import laplacian
from torchqm.geometry.mesh import Mesh
from torchqm.geometry.sampling import area_samples
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.cache import cache_folder, cached_basis
from torchqm.spectral.eigen import eigenbasis_and_note
from torchqm.spectral.features import smooth_curvature

__all__ = ["N_ANCHORS", "PreparedShape", "complete", "completions", "prepare"]

N_ANCHORS = 5000
"""Vertices of the target among which refinement steps look for partners, and around which dense searches look."""


@dataclass(frozen=True, eq=False)
class PreparedShape:
    """What matching needs to know of one shape.

    Args:
        mesh: scaled to total area 1.
        basis: its first eigenpairs, in the same scale.
        samples: ``(S,)`` vertex ids drawn by area without replacement; any first part of them is a sample, too.
        scale: sqrt of the original area: lengths of ``mesh`` times this are lengths of the file.
        operator: ``cotan`` or ``robust``, and why it was chosen.
        oriented: whether ``mesh`` is consistently oriented (normals outward); if not, direct and mirrored are the same.
        warnings: what was odd about the mesh and how it was handled.
    """

    mesh: Mesh
    basis: SpectralBasis
    samples: Int[Tensor, " S"]
    scale: float = 1.0
    operator: str = ""
    oriented: bool = True
    warnings: list[str] = field(default_factory=list)

    @property
    def n_verts(self) -> int:
        """Number of vertices."""
        return self.mesh.n_verts

    @property
    def anchors(self) -> Int[Tensor, " A"]:
        """The first :data:`N_ANCHORS` samples."""
        return self.samples[:N_ANCHORS]

    @cached_property
    def curvature(self) -> Float[Tensor, " V"]:
        """Smooth mean curvature (:func:`torchqm.spectral.features.smooth_curvature`)."""
        return _curvature(self)

    @cached_property
    def search(self) -> SurfaceSearch | None:
        """Two-stage search for dense maps onto this shape; None where it is small enough to compare all vertices."""
        return _search(self)


def _curvature(shape: PreparedShape) -> Float[Tensor, " V"]:
    with one_thread():  # sums of several threads have other last digits, and then other steps are the last ones
        return smooth_curvature(shape.mesh)


def _search(shape: PreparedShape) -> SurfaceSearch | None:
    if shape.n_verts < 2 * N_ANCHORS or len(shape.samples) < N_ANCHORS:
        return None
    far = torch.where(shape.mesh.referenced[:, None], shape.mesh.verts, 1e3)  # unit area: out of every neighbourhood
    return SurfaceSearch.build(far, shape.anchors)


_LAZY: dict[str, Callable[[PreparedShape], object]] = {"search": _search, "curvature": _curvature}


def complete(shapes: Sequence[PreparedShape], curvature: bool = True) -> None:
    """Compute what shapes compute when it is first asked for, all at the same time as far as there are workers.

    Args:
        shapes: the shapes.
        curvature: whether theirs is going to be used.
    """
    in_parallel(completions(shapes, curvature))


def completions(shapes: Sequence[PreparedShape], curvature: bool = True) -> list[Callable[[], None]]:
    """What is left to do for :func:`complete`, as tasks that may run beside others."""
    # Not through the properties: they lock, before Python 3.12 one for all shapes together.
    names = ["search", "curvature"] if curvature else ["search"]
    # Searches first, which take longer: what is begun last should end soon.
    todo = [(shape, name) for name in names for shape in dict.fromkeys(shapes) if name not in shape.__dict__]
    return [partial(_set, shape, name) for shape, name in todo]


def _set(shape: PreparedShape, name: str) -> None:
    shape.__dict__[name] = _LAZY[name](shape)


def prepare(
    mesh: Mesh,
    k: int = 200,
    n_samples: int = N_ANCHORS,
    seed: int = 0,
    kind: str = "auto",
    basis: SpectralBasis | None = None,
    cache_dir: str | Path | None = None,
) -> PreparedShape:
    """Scale a mesh to unit area and compute its first ``k`` eigenpairs.

    Args:
        mesh: a checked mesh (:func:`torchqm.geometry.check.check_mesh`).
        k: number of eigenpairs.
        n_samples: how many vertices stand for the surface in refinement steps.
        seed: of the samples.
        kind: Laplacian, see :func:`torchqm.geometry.laplacian.laplacian`.
        basis: eigenpairs of ``mesh.normalized()`` from an earlier run, to be used instead of computing them.
        cache_dir: folder of the spectral cache, where they are read from or kept; by default that of the environment
            variable ``TORCHQM_CACHE``, else nothing is kept. See :func:`torchqm.spectral.cache.cached_basis`.

    Raises:
        SpectrumError: fewer than ``k`` vertices with area.
    """
    report = inspect_mesh(mesh)
    unit, oriented, warnings = _outward(mesh, report)
    problems: tuple[str, ...] = ()
    if basis is None and cache_folder(cache_dir) is not None:
        kept = cached_basis(mesh, k, kind, cache_dir, whole_clusters=False, warn=False)
        scale = mesh.area**-0.5  # SpectralBasis.scaled, in place: nobody else has this array
        basis = SpectralBasis(kept.evals / scale**2, kept.evecs.div_(scale), kept.mass * scale**2)
        problems = kept.report.problems
        origin = f"{kept.report.source}{', from the cache' if kept.report.outcome == 'read' else ''}"
        operator = f"{kept.report.kind}: {kept.report.reason}; eigenpairs: {origin}"
    else:
        chosen = laplacian(mesh.normalized(), kind, report)
        if basis is None:
            basis, note = eigenbasis_and_note(chosen, k, mesh.label)
            problems = (note,) if note else ()
        else:
            basis = basis.truncate(k)
        operator = f"{chosen.kind}: {chosen.reason}"
    samples = area_samples(unit, min(n_samples, int((unit.vertex_areas > 0).sum())), seed)
    warnings = [*report.warnings, *(f"{mesh.label}: {text}" for text in warnings), *problems]
    return PreparedShape(unit, basis, samples, mesh.area**0.5, operator, oriented, warnings)


def _outward(mesh: Mesh, report: MeshReport) -> tuple[Mesh, bool, list[str]]:
    """Unit-area mesh with cleaned, consistently oriented triangles, normals outward where that has a meaning."""
    faces = clean_faces(mesh) if report.oriented else orient_faces(mesh)
    if faces is None:
        return mesh.normalized(), False, ["the surface is not orientable"]
    turned = replace(mesh, faces=faces).normalized()
    warnings = [] if report.oriented else ["some triangles were turned over so that neighbours agree"]
    # Volume of the cone over each triangle from the centroid: negative in total if the surface is inside out.
    volume = float((turned.verts[turned.faces[:, 0]] * turned.face_vectors).sum() / 6)
    if volume < 0:
        turned = replace(turned, faces=turned.faces.flip(1))
        warnings.append("the surface was inside out: all triangles were turned over")
    return turned, True, warnings
