"""The energies a functional map minimises, each as one function (paper, sections 4.2 and 4.3), one map or a batch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = [
    "commutativity_energy",
    "commutativity_weights",
    "descriptor_energy",
    "orthogonality_energy",
]

FMap = Float[Tensor, "*B Ky Kx"]


def descriptor_energy(
    fmap_xy: FMap, coeffs_x: Float[Tensor, "*B Kx C"], coeffs_y: Float[Tensor, "*B Ky C"]
) -> Float[Tensor, "*B"]:
    """``E_sig(C) = sum_s || C f_s - g_s ||^2``: corresponding descriptors go to each other (paper, section 4.3)."""
    return (fmap_xy @ coeffs_x - coeffs_y).square().sum((-2, -1))


def commutativity_weights(evals_x: Float[Tensor, "*B Kx"], evals_y: Float[Tensor, "*B Ky"]) -> FMap:
    """``(lambda_j - mu_i)^2``: the weight of each entry of C in :func:`commutativity_energy`."""
    return (evals_y[..., :, None] - evals_x[..., None, :]).square()


def commutativity_energy(
    fmap_xy: FMap, evals_x: Float[Tensor, "*B Kx"], evals_y: Float[Tensor, "*B Ky"]
) -> Float[Tensor, "*B"]:
    """``E_com(C) = sum_ij C_ij^2 (lambda_j - mu_i)^2 = || C Delta_x - Delta_y C ||^2`` (paper, section 4.3).

    Example:
        >>> commutativity_energy(torch.ones(1, 2), torch.tensor([0.0, 2.0]), torch.tensor([1.0])).item()
        2.0
    """
    return (fmap_xy.square() * commutativity_weights(evals_x, evals_y)).sum((-2, -1))


def orthogonality_energy(
    fmap_xy: FMap, mask_x: Bool[Tensor, "*B Kx"] | None = None, mask_y: Bool[Tensor, "*B Ky"] | None = None
) -> Float[Tensor, "*B"]:
    """``|| C^T C - I ||^2`` over the smaller side: zero for a functional isometry (paper, Lemma 4.1 ii).

    Args:
        fmap_xy: ``(..., Ky, Kx)`` takes functions on x to functions on y; 0 at padded functions.
        mask_x: ``(..., Kx)`` real functions of x, in a padded batch.
        mask_y: ``(..., Ky)`` real functions of y.
    """
    tall = fmap_xy.shape[-2] >= fmap_xy.shape[-1]
    adjoint = fmap_xy.transpose(-1, -2)
    gram = adjoint @ fmap_xy if tall else fmap_xy @ adjoint
    small, large = (mask_x, mask_y) if tall else (mask_y, mask_x)
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    energy = (gram - (eye if small is None else eye * small[..., None, :])).square().sum((-2, -1))
    if small is None and large is None:
        return energy
    # Of padded maps the smaller side may be the other one; the two energies differ by the number of functions more.
    small = torch.ones_like(fmap_xy[..., 0, :] if tall else fmap_xy[..., 0]) if small is None else small
    large = torch.ones_like(fmap_xy[..., 0] if tall else fmap_xy[..., 0, :]) if large is None else large
    return energy - (small.sum(-1) - large.sum(-1)).clamp_min(0)
