"""What a point looks like from near by: wave kernel signature and mean curvature, as a few comparable coordinates."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.curvature import mean_curvature
from torchqm.geometry.diffusion import diffused
from torchqm.geometry.laplacian import cotan_matrix
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.descriptors import wave_energies, wave_kernel_signature

__all__ = ["local_features", "smooth_curvature"]

SHARPEST = 200.0
"""Curvature at which a radius is too small to mean anything: 1/200 of the square root of the area."""

SMOOTHING = 1e-4
"""Diffusion time that takes the triangulation out of the curvature (area): 0.01 sqrt(area) wide."""


def smooth_curvature(mesh: Mesh) -> Float[Tensor, " V"]:
    """Mean curvature without its noise: at most :data:`SHARPEST`, diffused for :data:`SMOOTHING`.

    Not through a basis: what is finer than two hundred functions is worth much where a map drifts.

    Args:
        mesh: of area 1, consistently oriented, or the sign means nothing.
    """
    stiffness = cotan_matrix(mesh.verts, mesh.faces)
    sharp = mean_curvature(mesh, stiffness).clamp(-SHARPEST, SHARPEST)
    return diffused(mesh, sharp[:, None], SMOOTHING, stiffness=stiffness)[:, 0]


def local_features(
    bases: Sequence[SpectralBasis],
    curvatures: Sequence[Float[Tensor, "_V"]],
    ids: Sequence[Int[Tensor, "_S"]],
    oriented: bool = True,
    n_energies: int = 100,
    n_components: int = 15,
) -> list[Float[Tensor, "_V D"]]:
    """Coordinates in which points of several shapes that look alike are close to each other.

    Two parts of equal weight: the principal components of the logarithm of the wave kernel signature, and the mean
    curvature. Both are the same at a point and at its mirror image: these features say nothing of left and right.
    Mean and spread are those of all the shapes together, and a feature vector has length 1 in the root mean square.

    Args:
        bases: eigenfunctions of the shapes, which have the same area; as many are used as the smallest basis has.
        curvatures: of each shape (:func:`smooth_curvature`).
        ids: vertices drawn by area, where the features are wanted.
        oriented: whether all of them are consistently oriented; if not, the sign of the curvature means nothing, and
            its absolute value is taken.
        n_energies: of the wave kernel signature.
        n_components: principal components kept.

    Returns:
        For each shape ``(S, n_components + 1)``.

    Raises:
        ValueError: numbers of bases, curvatures and sets of ids differ.
    """
    if not len(bases) == len(curvatures) == len(ids):
        raise ValueError(
            f"{len(bases)} bases, {len(curvatures)} curvatures, {len(ids)} sets of ids: one of each is needed"
        )
    k = min(b.k for b in bases)
    bases = [b.truncate(k) for b in bases]
    energies = wave_energies(bases, n_energies)
    signatures = [wave_kernel_signature(b.restricted(i), energies) for b, i in zip(bases, ids, strict=True)]
    tiny = torch.finfo(torch.float64).tiny
    logs = _standard([s.clamp_min(tiny).log() for s in signatures])
    axes = torch.linalg.eigh(sum(v.T @ v / len(v) for v in logs))[1].flip(1)[:, :n_components]
    wave = _unit([v @ axes for v in logs])
    bends = _standard([(c if oriented else c.abs())[i, None] for c, i in zip(curvatures, ids, strict=True)])
    # Three standard deviations: beyond, a point is a tip or a crease, and how sharp it is depends on the pose.
    bends = _unit([v.clamp(-3.0, 3.0) for v in bends])
    return [torch.cat([w, h], 1) / 2**0.5 for w, h in zip(wave, bends, strict=True)]


def _standard(values: Sequence[Tensor]) -> list[Tensor]:
    """Mean 0 and variance 1 over all the shapes, each counting the same."""
    mean = torch.stack([v.mean(0) for v in values]).mean(0)
    spread = torch.stack([(v - mean).square().mean(0) for v in values]).mean(0).sqrt()
    # A sphere has the same values everywhere; rounding is not a feature.
    flat = spread <= 1e-9 * mean.abs().clamp_min(1.0)
    return [torch.where(flat, torch.zeros_like(v), (v - mean) / spread.clamp_min(1e-300)) for v in values]


def _unit(values: Sequence[Tensor]) -> list[Tensor]:
    """Root mean square length 1 over all the shapes, each counting the same."""
    square = sum(float(v.square().sum(1).mean()) for v in values) / len(values)
    return [v / max(square, 1e-300) ** 0.5 for v in values]
