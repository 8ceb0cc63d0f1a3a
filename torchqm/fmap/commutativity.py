"""Which entries of a functional map fit the two spectra: the kinds of Laplacian commutativity, by name."""

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["COMMUTATIVITY", "commutativity_mask", "spectral_scale"]

COMMUTATIVITY = ("squared", "normalized", "resolvent")


def spectral_scale(*evals: Float[Tensor, "*B _K"]) -> Float[Tensor, "*B"]:
    """The largest eigenvalue of several spectra, sample by sample: what counts as 1 in their comparison.

    Example:
        >>> spectral_scale(torch.tensor([0.0, 2.0]), torch.tensor([0.0, 1.0, 3.0])).item()
        3.0
    """
    return torch.cat(evals, -1).amax(-1).clamp_min(torch.finfo(evals[0].dtype).tiny)


def commutativity_mask(
    evals_x: Float[Tensor, "*B Kx"],
    evals_y: Float[Tensor, "*B Ky"],
    kind: str = "resolvent",
    gamma: float = 0.5,
    scale: Float[Tensor, "*B"] | None = None,
) -> Float[Tensor, "*B Ky Kx"]:
    """How badly each entry of a functional map fits the two spectra: ``D_ij`` from ``mu_i`` of y and ``lambda_j`` of x.

    ===============  ============================================================================================
    ``squared``      ``(mu_i - lambda_j)^2``: ``sum D C^2 = || C Delta_x - Delta_y C ||^2`` (the paper)
    ``normalized``   the same, both spectra divided by ``scale``
    ``resolvent``    ``| 1 / (p_i + i) - 1 / (q_j + i) |^2 = (p_i - q_j)^2 / ((1 + p_i^2) (1 + q_j^2))`` with
                     ``p = (mu / scale)^gamma``, ``q = (lambda / scale)^gamma`` (ULRSSM, DPFM)
    ===============  ============================================================================================

    Args:
        evals_x: ``(..., Kx)`` eigenvalues of the source.
        evals_y: ``(..., Ky)`` eigenvalues of the target.
        kind: one of the three names.
        gamma: of the resolvent. Its eigenvalues below zero count as zero, and those that rounding leaves of the
            constant function's zero get gradient zero: for ``gamma < 1`` the power has an infinite slope there.
        scale: ``(...)`` the eigenvalue that counts as 1; None: :func:`spectral_scale` of the pair.

    Raises:
        ValueError: an unknown kind, or ``gamma`` not above zero.

    Example:
        >>> commutativity_mask(torch.tensor([0.0, 1.0]), torch.tensor([0.0, 2.0]), "normalized").tolist()
        [[0.0, 0.25], [1.0, 0.25]]

    References:
        Paper, section 4.3, E_com; Ren, Panine, Wonka, Ovsjanikov, Structured Regularization of Functional Map
        Computations, 2019 (the resolvent); Cao, Roetzer, Bernard, Unsupervised Learning of Robust Spectral Shape
        Matching, 2023 (this form of it).
    """
    if kind not in COMMUTATIVITY:
        raise ValueError(f"commutativity is {kind!r}; allowed are {', '.join(COMMUTATIVITY)}")
    if not gamma > 0:
        raise ValueError(f"gamma is {gamma}; only numbers above zero are allowed")
    if kind != "squared":
        scale = spectral_scale(evals_x, evals_y) if scale is None else scale
        evals_x, evals_y = evals_x / scale[..., None], evals_y / scale[..., None]
    if kind != "resolvent":
        return (evals_y[..., :, None] - evals_x[..., None, :]).square()
    q, p = (_power(e, gamma) for e in (evals_x, evals_y))
    return (p[..., :, None] - q[..., None, :]).square() / (
        (1 + p.square())[..., :, None] * (1 + q.square())[..., None, :]
    )


def _power(evals: Tensor, gamma: float) -> Tensor:
    """``evals^gamma``, constant in the gradient where an eigenvalue is rounding of zero (the largest is about 1)."""
    real = evals > evals.shape[-1] * torch.finfo(evals.dtype).eps
    # The inner where keeps the slope at zero out of the gradient.
    return torch.where(real, torch.where(real, evals, 1.0).pow(gamma), evals.detach().clamp_min(0).pow(gamma))
