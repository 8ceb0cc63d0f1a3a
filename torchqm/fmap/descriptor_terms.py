"""What descriptors bring to the regularised map: coefficients, weights, and the energy that others are measured by."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.checks import Sizes, enabled, require_finite, require_nonnegative, require_real

__all__ = ["descriptor_coefficients", "mean_energy", "one_a_sample", "weighted_descriptors"]


def descriptor_coefficients(
    feat: Float[Tensor, "*B V C"],
    evecs_trans: Float[Tensor, "*B K V"],
    names: tuple[str, str] = ("feat", "evecs_trans"),
) -> Float[Tensor, "*B K C"]:
    """``Phi^T A f``: features at vertices, written in a basis.

    Args:
        feat: ``(..., V, C)`` values at vertices; where ``evecs_trans`` is zero (padding), any finite ones.
        evecs_trans: ``(..., K, V)`` transposed basis times vertex areas.
        names: what the two are called in messages.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.

    Example:
        >>> descriptor_coefficients(torch.tensor([[1.0], [3.0]]), torch.tensor([[0.5, 0.5]])).tolist()
        [[2.0]]
    """
    sizes = Sizes()
    sizes.bind(names[0], feat, "... V C")
    sizes.bind(names[1], evecs_trans, "... K V")
    require_real(names[0], feat)
    require_real(names[1], evecs_trans)
    coeffs = evecs_trans @ feat
    if enabled() and not bool(torch.isfinite(coeffs).all()):  # small beside the features, which are looked at now only
        require_finite(names[0], feat)
        require_finite(names[1], evecs_trans)
    return coeffs


def mean_energy(grams: Sequence[Tensor], masks: Sequence[Tensor | None]) -> Tensor:
    """``(..., 1, 1)`` mean diagonal entry of ``s A W A^T`` over the real functions of all blocks; 1 instead of 0.

    Args:
        grams: for each block ``(..., K, K)``, zero where the functions are padding.
        masks: for each block ``(..., K)`` true: real; None: all are.
    """
    total: Tensor | float = 0.0
    count: Tensor | float = 0.0
    for gram, mask in zip(grams, masks, strict=True):
        total = total + gram.diagonal(dim1=-2, dim2=-1).sum(-1)
        count = count + (gram.shape[-1] if mask is None else mask.sum(-1))
    mean = torch.as_tensor(total / torch.as_tensor(count).clamp_min(1))
    return torch.where(mean > 0, mean, 1.0)[..., None, None]


def weighted_descriptors(coeffs: Tensor, weights: Tensor | None, sample_weights: Tensor | None, sizes: Sizes) -> Tensor:
    """``s A W``."""
    if weights is not None:
        sizes.bind("weights", weights, "C" if weights.ndim == 1 else "... C", any_dtype=True)
        weights = weights.to(coeffs.dtype)
        require_nonnegative("weights", weights)
        coeffs = coeffs * weights[..., None, :]
    if sample_weights is not None:
        sizes.bind("sample_weights", sample_weights[..., None], "... 1", any_dtype=True)
        sample_weights = sample_weights.to(coeffs.dtype)
        require_nonnegative("sample_weights", sample_weights)
        coeffs = coeffs * sample_weights[..., None, None]
    return coeffs


def one_a_sample(lmbda: float | Tensor, sizes: Sizes) -> float | Tensor:
    """To be multiplied with matrices."""
    if not isinstance(lmbda, Tensor):
        if not 0 <= lmbda < float("inf"):
            raise ValueError(f"lmbda is {lmbda}; only finite numbers from zero are allowed")
        return lmbda
    if lmbda.ndim:
        sizes.bind("lmbda", lmbda[..., None], "... 1", any_dtype=True)
    if not lmbda.is_floating_point():
        lmbda = lmbda.to(torch.get_default_dtype())
    require_nonnegative("lmbda", lmbda)
    return lmbda[..., None, None] if lmbda.ndim else lmbda
