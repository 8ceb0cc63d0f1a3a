"""The energies a functional map minimises, each as one function (paper, sections 4.2 and 4.3)."""

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = [
    "commutativity_energy",
    "commutativity_weights",
    "descriptor_energy",
    "orthogonality_energy",
]

FMap = Float[Tensor, "Ky Kx"]


def descriptor_energy(fmap_xy: FMap, coeffs_x: Float[Tensor, "Kx C"], coeffs_y: Float[Tensor, "Ky C"]) -> Tensor:
    """``E_sig(C) = sum_s || C f_s - g_s ||^2``: corresponding descriptors go to each other (paper, section 4.3)."""
    return (fmap_xy @ coeffs_x - coeffs_y).square().sum()


def commutativity_weights(evals_x: Float[Tensor, " Kx"], evals_y: Float[Tensor, " Ky"]) -> FMap:
    """``(lambda_j - mu_i)^2``: the weight of each entry of C in :func:`commutativity_energy`."""
    return (evals_y[:, None] - evals_x[None, :]).square()


def commutativity_energy(fmap_xy: FMap, evals_x: Float[Tensor, " Kx"], evals_y: Float[Tensor, " Ky"]) -> Tensor:
    """``E_com(C) = sum_ij C_ij^2 (lambda_j - mu_i)^2 = || C Delta_x - Delta_y C ||^2`` (paper, section 4.3).

    Example:
        >>> commutativity_energy(torch.ones(1, 2), torch.tensor([0.0, 2.0]), torch.tensor([1.0])).item()
        2.0
    """
    return (fmap_xy.square() * commutativity_weights(evals_x, evals_y)).sum()


def orthogonality_energy(fmap_xy: FMap) -> Tensor:
    """``|| C^T C - I ||^2`` over the smaller side: zero for a functional isometry (paper, Lemma 4.1 ii)."""
    gram = fmap_xy.T @ fmap_xy if fmap_xy.shape[0] >= fmap_xy.shape[1] else fmap_xy @ fmap_xy.T
    return (gram - torch.eye(gram.shape[0], dtype=gram.dtype)).square().sum()
