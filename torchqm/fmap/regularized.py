"""The regularised functional map: descriptor preservation and Laplacian commutativity in closed form, batched, masked.

``E(C) = s sum_c w_c || C a_c - b_c ||^2 + lmbda sum_ij D_ij C_ij^2``, where D says how badly entry (i, j) fits the two
spectra (:mod:`torchqm.fmap.commutativity`). The energy falls apart into the rows of C (:mod:`torchqm.fmap.rows`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.checks import Sizes, require_finite, require_mask
from torchqm.fmap.commutativity import commutativity_mask, spectral_scale
from torchqm.fmap.descriptor_terms import descriptor_coefficients, mean_energy, one_a_sample, weighted_descriptors
from torchqm.fmap.rows import solve_rows

__all__ = [
    "descriptor_coefficients",
    "regularized_blocks",
    "regularized_fmap",
]


def regularized_fmap(
    coeffs_x: Float[Tensor, "*B Kx C"],
    coeffs_y: Float[Tensor, "*B Ky C"],
    evals_x: Float[Tensor, "*B Kx"],
    evals_y: Float[Tensor, "*B Ky"],
    lmbda: float | Float[Tensor, "..."] = 100.0,
    *,
    commutativity: str = "resolvent",
    gamma: float = 0.5,
    weights: Float[Tensor, "..."] | None = None,
    sample_weights: Float[Tensor, "*B"] | None = None,
    ridge: float = 0.0,
    evals_mask_x: Bool[Tensor, "*B Kx"] | None = None,
    evals_mask_y: Bool[Tensor, "*B Ky"] | None = None,
    scale: Float[Tensor, "*B"] | None = None,
    row_chunk: int | None = None,
) -> Float[Tensor, "*B Ky Kx"]:
    """The C that minimises ``s sum_c w_c || C a_c - b_c ||^2 + lmbda sum_ij D_ij C_ij^2 + r || C ||^2``.

    Row i solves ``(s A W A^T + diag(lmbda D_i + r)) c_i = s A W b_i``. Gradients go to everything that is a tensor.

    Args:
        coeffs_x: ``(..., Kx, C)`` descriptors of the source in its basis (the a_c as columns). More descriptors, such
            as odd ones, are more columns; ``weights`` says how much they count.
        coeffs_y: ``(..., Ky, C)`` the same descriptors of the target (b_c). Ky and Kx may differ (semi-quotient).
        evals_x: ``(..., Kx)`` eigenvalues of the source.
        evals_y: ``(..., Ky)`` eigenvalues of the target.
        lmbda: weight of commutativity: a number, or a tensor with one number or one a sample.
        commutativity: kind of D, see :func:`torchqm.fmap.commutativity.commutativity_mask`.
        gamma: of the resolvent.
        weights: w, ``(C,)`` or ``(..., C)``, not negative.
        sample_weights: s ``(...)``, not negative: how far the descriptors of each sample are trusted.
        ridge: r as a multiple of the mean descriptor energy (the mean diagonal entry of ``s A W A^T``, or 1 where that
            is zero): entries that neither descriptors nor commutativity determine become 0 instead of an error. Below
            the precision of the dtype it does nothing: give 1e-3 in float32, 1e-9 in float64.
        evals_mask_x: ``(..., Kx)`` true: real, false: padding.
        evals_mask_y: ``(..., Ky)`` the same of the target.
        scale: see :func:`torchqm.fmap.commutativity.commutativity_mask`.
        row_chunk: see :func:`torchqm.fmap.rows.solve_rows`.

    Returns:
        ``fmap_xy`` ``(..., Ky, Kx)``: takes functions on x to functions on y; 0 where either mask is false.

    Raises:
        ValueError: shapes that do not fit, values that are not finite, negative weights, or (naming samples and rows)
            an energy without a unique minimum.

    Example:
        >>> f, spectrum = torch.eye(2).double(), torch.tensor([0.0, 1.0]).double()
        >>> regularized_fmap(f, -f, spectrum, spectrum).tolist()
        [[-1.0, 0.0], [0.0, -1.0]]

    References:
        Paper, section 4.3, E_0 = E_sig + E_com; Donati, Sharma, Ovsjanikov, Deep Geometric Functional Maps, 2020 (row
        by row).
    """
    for name, mask in (("evals_mask_x", evals_mask_x), ("evals_mask_y", evals_mask_y)):
        if mask is not None:
            require_mask(name, mask)
    terms = _terms(coeffs_x, coeffs_y, evals_x, evals_y, evals_mask_x, evals_mask_y, weights, sample_weights)
    return _minima([terms], lmbda, commutativity, gamma, ridge, scale, row_chunk)[0]


def regularized_blocks(
    coeffs_x: Sequence[Float[Tensor, "..."]],
    coeffs_y: Sequence[Float[Tensor, "..."]],
    evals_x: Sequence[Float[Tensor, "..."]],
    evals_y: Sequence[Float[Tensor, "..."]],
    lmbda: float | Float[Tensor, "..."] = 100.0,
    *,
    commutativity: str = "resolvent",
    gamma: float = 0.5,
    weights: Float[Tensor, "..."] | None = None,
    sample_weights: Float[Tensor, "..."] | None = None,
    ridge: float = 0.0,
    evals_mask_x: Sequence[Bool[Tensor, "..."] | None] | None = None,
    evals_mask_y: Sequence[Bool[Tensor, "..."] | None] | None = None,
    scale: Float[Tensor, "..."] | None = None,
    row_chunk: int | None = None,
) -> tuple[Float[Tensor, "..."], ...]:
    """The blocks of a block-diagonal map: even to even, odd to odd.

    They are those that :func:`regularized_fmap` gives for all at once, where each descriptor lies in one block (an even
    one has no odd part): all blocks share one ``scale``. Two halves take a quarter of the memory and an eighth of the
    multiplications.

    Args:
        coeffs_x: for each block ``(..., Kx, C)`` descriptors of the source in the basis of that block. Blocks may
            differ in Kx (zero, too) and in C; ``weights`` are possible only if C is one for all.
        coeffs_y: for each block ``(..., Ky, C)``.
        evals_x: for each block ``(..., Kx)``.
        evals_y: for each block ``(..., Ky)``.
        lmbda: this and the following as in :func:`regularized_fmap`.
        commutativity: kind of D.
        gamma: of the resolvent.
        weights: ``(C,)`` or ``(..., C)``.
        sample_weights: ``(...)``.
        ridge: multiple of the mean descriptor energy of all blocks. A block whose descriptors are rounding beside those
            of the others counts as one without descriptors.
        evals_mask_x: for each block ``(..., Kx)``; all blocks but the first may be padding alone.
        evals_mask_y: for each block ``(..., Ky)``.
        scale: ``(...)``; None: the largest eigenvalue of all blocks of the pair.
        row_chunk: see :func:`torchqm.fmap.rows.solve_rows`.

    Returns:
        For each block ``fmap_xy`` ``(..., Ky, Kx)``.

    Example:
        >>> f, even, odd = torch.eye(2).double(), torch.tensor([0.0, 2.0]).double(), torch.tensor([1.0]).double()
        >>> blocks = regularized_blocks([f, f[:1]], [f, -f[:1]], [even, odd], [even, odd])
        >>> [block.tolist() for block in blocks]
        [[[1.0, 0.0], [0.0, 1.0]], [[-1.0]]]
    """
    masks_x, masks_y = ([None] * len(coeffs_x) if m is None else m for m in (evals_mask_x, evals_mask_y))
    blocks = {"coeffs_y": coeffs_y, "evals_x": evals_x, "evals_y": evals_y}
    for name, parts in {**blocks, "evals_mask_x": masks_x, "evals_mask_y": masks_y}.items():
        if len(parts) != len(coeffs_x):
            raise ValueError(f"{name}: {len(parts)} blocks given, coeffs_x has {len(coeffs_x)}")
    spectra = []
    for side, evals, masks in (("x", evals_x, masks_x), ("y", evals_y, masks_y)):
        for number, (e, m) in enumerate(zip(evals, masks, strict=True)):
            if m is not None:
                sizes = Sizes()
                sizes.bind(f"evals_{side}[{number}]", e, "... K")
                sizes.bind(f"evals_mask_{side}[{number}]", m, "... K")
                if number == 0:  # the constant function is even; a shape without symmetry has no odd functions
                    require_mask(f"evals_mask_{side}[0]", m)
                e = e * m
            spectra.append(e)
    scale = spectral_scale(*spectra) if scale is None else scale
    terms = [
        _terms(a, b, x, y, mask_x, mask_y, weights, sample_weights)
        for a, b, x, y, mask_x, mask_y in zip(coeffs_x, coeffs_y, evals_x, evals_y, masks_x, masks_y, strict=True)
    ]
    return _minima(terms, lmbda, commutativity, gamma, ridge, scale, row_chunk)


class _Terms(NamedTuple):
    """What one block's energy is made of; padding is zero."""

    gram: Tensor
    rhs: Tensor
    evals_x: Tensor
    evals_y: Tensor
    mask_x: Tensor | None
    mask_y: Tensor | None
    sizes: Sizes


def _terms(
    coeffs_x: Tensor,
    coeffs_y: Tensor,
    evals_x: Tensor,
    evals_y: Tensor,
    mask_x: Tensor | None,
    mask_y: Tensor | None,
    weights: Tensor | None,
    sample_weights: Tensor | None,
) -> _Terms:
    sizes = Sizes()
    sizes.bind("coeffs_x", coeffs_x, "... Kx C")
    sizes.bind("coeffs_y", coeffs_y, "... Ky C")
    sizes.bind("evals_x", evals_x, "... Kx")
    sizes.bind("evals_y", evals_y, "... Ky")
    for name, tensor in (("coeffs_x", coeffs_x), ("coeffs_y", coeffs_y), ("evals_x", evals_x), ("evals_y", evals_y)):
        require_finite(name, tensor)
    if mask_x is not None:
        sizes.bind("evals_mask_x", mask_x, "... Kx")
        coeffs_x, evals_x = coeffs_x * mask_x[..., None], evals_x * mask_x
    if mask_y is not None:
        sizes.bind("evals_mask_y", mask_y, "... Ky")
        coeffs_y, evals_y = coeffs_y * mask_y[..., None], evals_y * mask_y
    weighted = weighted_descriptors(coeffs_x, weights, sample_weights, sizes)
    return _Terms(weighted @ coeffs_x.mT, coeffs_y @ weighted.mT, evals_x, evals_y, mask_x, mask_y, sizes)


def _minima(
    blocks: Sequence[_Terms],
    lmbda: float | Tensor,
    commutativity: str,
    gamma: float,
    ridge: float,
    scale: Tensor | None,
    row_chunk: int | None,
) -> tuple[Tensor, ...]:
    if not 0 <= ridge < float("inf"):
        raise ValueError(f"ridge is {ridge}; only finite numbers from zero are allowed")
    grams = [block.gram if ridge else block.gram.detach() for block in blocks]
    masks = [block.mask_x for block in blocks]
    energy, found = mean_energy(grams, masks), []
    for block, own, mask in zip(blocks, grams, masks, strict=True):
        gram, rhs = block.gram, block.rhs
        if len(blocks) > 1:  # of a block that holds only what rounding leaves, nothing is known
            least = (block.sizes["C"] * torch.finfo(gram.dtype).eps) ** 2 * energy
            noise = mean_energy([own], [mask]) <= least
            gram, rhs = torch.where(noise, 0.0, gram), torch.where(noise, 0.0, rhs)
        pulls = commutativity_mask(block.evals_x, block.evals_y, commutativity, gamma, scale)
        diagonal = one_a_sample(lmbda, block.sizes) * pulls
        if ridge:
            diagonal = diagonal + ridge * energy
        # Systems of padding have a solution, too: 0.
        if block.mask_x is not None:
            diagonal = torch.where(block.mask_x[..., None, :], diagonal, energy.detach())
        if block.mask_y is not None:
            diagonal = torch.where(block.mask_y[..., :, None], diagonal, energy.detach())
        found.append(solve_rows(gram, diagonal.to(gram.dtype), rhs, row_chunk))
    return tuple(found)
