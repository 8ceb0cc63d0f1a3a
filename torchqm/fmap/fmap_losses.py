"""Losses of pairs of functional maps without truth: bijectivity, orthogonality, commutativity (SURFMNet)."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.checks import Sizes, require_finite, require_mask
from torchqm.fmap.energy import commutativity_energy, orthogonality_energy

__all__ = ["bijectivity_energy", "surfmnet_losses"]


def bijectivity_energy(
    fmap_xy: Float[Tensor, "*B Ky Kx"],
    fmap_yx: Float[Tensor, "*B Kx Ky"],
    mask_x: Bool[Tensor, "*B Kx"] | None = None,
    mask_y: Bool[Tensor, "*B Ky"] | None = None,
) -> Float[Tensor, "*B"]:
    """``|| C_xy C_yx - I ||^2 + || C_yx C_xy - I ||^2 - |Kx - Ky|``: each map undoes the other.

    The product over the larger side has at most the rank of the smaller one, so ``|Kx - Ky|`` is the least value of the
    two norms; without it, a perfect rectangular map would not have energy 0.

    Args:
        fmap_xy: takes functions on x to functions on y; 0 at padded functions.
        fmap_yx: takes functions on y to functions on x.
        mask_x: ``(..., Kx)`` real functions of x, in a padded batch.
        mask_y: ``(..., Ky)`` real functions of y.

    Example:
        >>> bijectivity_energy(torch.eye(2)[:1], torch.eye(2)[:, :1]).item()
        0.0
    """
    total, difference = torch.zeros_like(fmap_xy[..., 0, 0]), torch.zeros_like(fmap_xy[..., 0, 0])
    for product, mask, sign in ((fmap_xy @ fmap_yx, mask_y, 1), (fmap_yx @ fmap_xy, mask_x, -1)):
        eye = torch.eye(product.shape[-1], dtype=product.dtype, device=product.device)
        wanted = eye if mask is None else eye * mask[..., None, :]
        total = total + (product - wanted).square().sum((-2, -1))
        difference = difference + sign * wanted.sum((-2, -1))
    return total - difference.abs()


def surfmnet_losses(
    fmap_xy: Float[Tensor, "*B Ky Kx"],
    fmap_yx: Float[Tensor, "*B Kx Ky"],
    evals_x: Float[Tensor, "*B Kx"],
    evals_y: Float[Tensor, "*B Ky"],
    mask_x: Bool[Tensor, "*B Kx"] | None = None,
    mask_y: Bool[Tensor, "*B Ky"] | None = None,
    names: Sequence[str] = ("fmap_xy", "fmap_yx", "evals_x", "evals_y", "mask_x", "mask_y"),
) -> dict[str, Float[Tensor, "*B"]]:
    """The bijectivity, orthogonality and commutativity energies of two maps, unweighted, for each pair.

    ``l_bij``: :func:`bijectivity_energy`; ``l_orth``: :func:`~torchqm.fmap.energy.orthogonality_energy` of both maps
    (of a rectangular one over its smaller side); ``l_lap``: :func:`~torchqm.fmap.energy.commutativity_energy` of both,
    with the eigenvalues as they are. For square maps they are SURFMNet's formulas.

    Args:
        fmap_xy: ``(..., Ky, Kx)`` takes functions on x to functions on y.
        fmap_yx: ``(..., Kx, Ky)`` takes functions on y to functions on x.
        evals_x: ``(..., Kx)`` eigenvalues of x.
        evals_y: ``(..., Ky)`` eigenvalues of y.
        mask_x: ``(..., Kx)`` real functions of x; what the maps hold at others is left out.
        mask_y: ``(..., Ky)`` real functions of y.
        names: what the six are called in messages.

    Returns:
        ``l_bij``, ``l_orth`` and ``l_lap``, each ``(...)``.

    Raises:
        ValueError: shapes do not fit, or something is not finite.

    Example:
        >>> evals, eye = torch.tensor([0.0, 1.0]), torch.eye(2)
        >>> {name: loss.item() for name, loss in surfmnet_losses(eye, 2 * eye, evals, evals).items()}
        {'l_bij': 4.0, 'l_orth': 18.0, 'l_lap': 0.0}

    References:
        Roufosse, Sharma and Ovsjanikov, Unsupervised deep learning for structured shape matching, ICCV 2019.
    """
    sizes = Sizes()
    given = ((fmap_xy, "... Ky Kx"), (fmap_yx, "... Kx Ky"), (evals_x, "... Kx"), (evals_y, "... Ky"))
    for name, (value, dims) in zip(names[:4], given, strict=True):
        sizes.bind(name, value, dims)
        require_finite(name, value)
    for name, mask, dims in zip(names[4:], (mask_x, mask_y), ("... Kx", "... Ky"), strict=True):
        if mask is not None:
            sizes.bind(name, mask, dims)
            require_mask(name, mask)
    if mask_x is not None:
        fmap_xy, fmap_yx = fmap_xy * mask_x[..., None, :], fmap_yx * mask_x[..., :, None]
    if mask_y is not None:
        fmap_xy, fmap_yx = fmap_xy * mask_y[..., :, None], fmap_yx * mask_y[..., None, :]
    orthogonality = orthogonality_energy(fmap_xy, mask_x, mask_y) + orthogonality_energy(fmap_yx, mask_y, mask_x)
    commutativity = commutativity_energy(fmap_xy, evals_x, evals_y) + commutativity_energy(fmap_yx, evals_y, evals_x)
    return {
        "l_bij": bijectivity_energy(fmap_xy, fmap_yx, mask_x, mask_y),
        "l_orth": orthogonality,
        "l_lap": commutativity,
    }
