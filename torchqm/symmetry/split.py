"""Even and odd bases of a batch of shapes, with gauge-invariant gradients (paper, Lemma 3.1).

The mathematics is that of :mod:`torchqm.symmetry.basis`, which splits one shape and has no gradients to care for.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchqm.checks import Sizes, require_finite
from torchqm.spectral.soft_map import SoftMap
from torchqm.symmetry.halves import find_halves
from torchqm.symmetry.invariant import column_signs, invariant_eigh
from torchqm.symmetry.soft import check_basis, check_symmetry, project, without_padding

__all__ = ["SplitBases", "split_bases", "symmetrized_bases"]


@dataclass(frozen=True, eq=False)
class SplitBases:
    """Bases of the even functions (L2+) and of their complement (L2-) for a batch of shapes, padded with zeros.

    Args:
        evals_even: ``(..., K+)`` eigenvalues of the Laplacian restricted to L2+, ascending (1 / area).
        evecs_even: ``(..., V, K+)`` its eigenfunctions, orthonormal in ``mass``.
        coeffs_even: ``(..., K, K+)`` the same functions written in the full basis.
        evals_even_mask: ``(..., K+)`` which of them are real.
        evals_odd: ``(..., K-)`` likewise on L2-.
        evecs_odd: ``(..., V, K-)``.
        coeffs_odd: ``(..., K, K-)``.
        evals_odd_mask: ``(..., K-)``.
        spectrum: ``(..., K)`` eigenvalues of the symmetric part of the projection, ascending, 0 after the real ones.
            How far they are from 0 and 1 tells how exact the symmetry is in this basis; near 1/2 the halves are
            arbitrary.
        mass: ``(..., V)`` vertex areas, 0 where a vertex is padding.
    """

    evals_even: Float[Tensor, "*B Ke"]
    evecs_even: Float[Tensor, "*B V Ke"]
    coeffs_even: Float[Tensor, "*B K Ke"]
    evals_even_mask: Bool[Tensor, "*B Ke"]
    evals_odd: Float[Tensor, "*B Ko"]
    evecs_odd: Float[Tensor, "*B V Ko"]
    coeffs_odd: Float[Tensor, "*B K Ko"]
    evals_odd_mask: Bool[Tensor, "*B Ko"]
    spectrum: Float[Tensor, "*B K"]
    mass: Float[Tensor, "*B V"]

    @property
    def evecs_trans_even(self) -> Float[Tensor, "*B Ke V"]:
        """``evecs_even^T diag(mass)``: from vertex values to coefficients; computed anew each time."""
        return (self.evecs_even * self.mass[..., None]).mT

    @property
    def evecs_trans_odd(self) -> Float[Tensor, "*B Ko V"]:
        """``evecs_odd^T diag(mass)``."""
        return (self.evecs_odd * self.mass[..., None]).mT


torch.export.register_dataclass(SplitBases)  # so that a layer that returns one can be exported and vmapped


def split_bases(
    evals: Float[Tensor, "*B K"],
    evecs: Float[Tensor, "*B V K"],
    mass: Float[Tensor, "*B V"],
    projection: Float[Tensor, "*B K K"],
    *,
    verts_mask: Bool[Tensor, "*B V"] | None = None,
    evals_mask: Bool[Tensor, "*B K"] | None = None,
    k_even: int | None = None,
    k_odd: int | None = None,
    rtol: float | None = None,
) -> SplitBases:
    """Split each basis by an approximate projector onto its even functions.

    The even half is the eigenspace of ``(P + P^T) / 2`` above one half, the odd half is the rest; inside each the
    Laplacian ``diag(evals)`` is diagonalised again. Both steps are one ``eigh`` of all K functions: in the second one
    the halves are blocks that a shift keeps apart.

    Gradients go to ``evals``, ``evecs`` and ``projection`` (``mass`` only comes along); they are those of
    :func:`~torchqm.symmetry.invariant.split_eigh` and :func:`~torchqm.symmetry.invariant.invariant_eigh`, that is exact
    for losses that depend on whole clusters of equal eigenvalues (see :mod:`torchqm.symmetry.invariant`), with
    eigenvalues compared inside one half. ``spectrum`` carries gradients, too. No gradient goes through the choice of
    signs, nor through that of the halves.

    Args:
        evals: ``(..., K)`` eigenvalues.
        evecs: ``(..., V, K)`` eigenfunctions.
        mass: ``(..., V)`` vertex areas.
        projection: ``(..., K, K)`` from :func:`~torchqm.symmetry.soft.projection_matrices`.
        verts_mask: ``(..., V)`` which vertices are real.
        evals_mask: ``(..., K)`` which functions are. Padded ones end in neither half.
        k_even: width of the even half: padded with zeros, or cut to the lowest. Cut in a gap of the spectrum: of a
            cluster's functions a part is not determined. By default the batch's largest even half; this width depends
            on the data, so ``torch.compile`` (in one graph), ``torch.export`` and ``torch.func.vmap`` need a number.
        k_odd: that of the odd half.
        rtol: gaps of eigenvalues that count as zero in the backward pass, as a share of the largest eigenvalue.

    Returns:
        Both halves. Signs are chosen by the rule of :func:`torchqm.spectral.fix_signs`, in the full basis.

    Raises:
        ValueError: sizes do not fit, a number is not finite, or no function of some shape is symmetric (then
            ``projection`` is no projector of a group: the constant function always is). What depends on values is not
            checked in compiled code and not inside :func:`torchqm.checks.disabled`.

    Example:
        >>> evecs = torch.tensor([[1.0, 1.0], [1.0, -1.0]]) / 2**0.5
        >>> even = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
        >>> split = split_bases(torch.tensor([0.0, 3.0]), evecs, torch.ones(2), even)
        >>> split.evals_even.tolist(), split.evals_odd.tolist(), split.coeffs_odd.tolist()
        ([0.0], [3.0], [[0.0], [1.0]])

    References:
        Paper, Lemma 3.1 and the first step of Algorithm 1.
    """
    sizes = check_basis(evecs, mass, verts_mask, evals_mask)
    _check_numbers(sizes, evals, k_even, k_odd)
    sizes.bind("projection", projection, "... K K")
    require_finite("projection", projection)
    evecs, mass = without_padding(evecs, mass, verts_mask, evals_mask)
    return _split(evals, evecs, mass, projection, evals_mask, k_even, k_odd, rtol)


def symmetrized_bases(
    evals: Float[Tensor, "*B K"],
    evecs: Float[Tensor, "*B V K"],
    mass: Float[Tensor, "*B V"],
    *,
    group: Int[Tensor, "*B G V"] | None = None,
    fmaps: Float[Tensor, "..."] | None = None,
    soft_map: "SoftMap | Float[Tensor, '*B V V'] | None" = None,
    group_mask: Bool[Tensor, "*B G"] | None = None,
    verts_mask: Bool[Tensor, "*B V"] | None = None,
    evals_mask: Bool[Tensor, "*B K"] | None = None,
    k_even: int | None = None,
    k_odd: int | None = None,
    rtol: float | None = None,
) -> SplitBases:
    """The even and odd bases of shapes with known symmetries: a projection of each kind, then :func:`split_bases`.

    For a single shape and its group this is :func:`torchqm.symmetry.symmetrized_basis`, up to the gauge.

    Args:
        evals: ``(..., K)`` eigenvalues.
        evecs: ``(..., V, K)`` eigenfunctions, orthonormal in ``mass``.
        mass: ``(..., V)`` vertex areas.
        group: vertex maps, or
        fmaps: functional matrices, or
        soft_map: a soft map of the shape to itself: as in :func:`~torchqm.symmetry.soft.projection_matrices`.
        group_mask: ``(..., G)`` which elements are real.
        verts_mask: ``(..., V)`` which vertices are.
        evals_mask: ``(..., K)`` which functions are.
        k_even: width of the even half, as in :func:`split_bases`.
        k_odd: that of the odd one.
        rtol: gaps that count as zero in the backward pass.

    Returns:
        Both halves, with gradients to ``evals``, ``evecs``, ``mass`` and the symmetry.

    Raises:
        ValueError: as in :func:`~torchqm.symmetry.soft.projection_matrices` and :func:`split_bases`.

    Example:
        >>> evecs = torch.tensor([[1.0, 1.0], [1.0, -1.0]]) / 2**0.5
        >>> reflection = torch.tensor([[1.0, 0.0], [0.0, -1.0]])
        >>> split = symmetrized_bases(torch.tensor([0.0, 3.0]), evecs, torch.ones(2), fmaps=reflection)
        >>> split.evals_odd.tolist(), split.spectrum.tolist()
        ([3.0], [0.0, 1.0])
    """
    sizes = check_basis(evecs, mass, verts_mask, evals_mask)
    _check_numbers(sizes, evals, k_even, k_odd)
    check_symmetry(sizes, group, fmaps, soft_map, group_mask, verts_mask)
    evecs, mass = without_padding(evecs, mass, verts_mask, evals_mask)
    projection = project(evecs, mass, group, fmaps, soft_map, group_mask, evals_mask)
    return _split(evals, evecs, mass, projection, evals_mask, k_even, k_odd, rtol)


def _split(
    evals: Tensor,
    evecs: Tensor,
    mass: Tensor,
    projection: Tensor,
    evals_mask: Tensor | None,
    k_even: int | None,
    k_odd: int | None,
    rtol: float | None,
) -> SplitBases:
    place = torch.arange(evals.shape[-1], device=evals.device)
    if evals_mask is not None:
        evals = torch.where(evals_mask, evals, 0.0)
    halves = find_halves(projection, evals_mask, rtol)
    vectors, even, padding, n_even, n = halves[1:]
    # Padding, odd and even functions are three blocks of one matrix, moved apart: all real eigenvalues are in [-1, 1].
    top = evals.detach().abs().amax(-1, keepdim=True)
    unit = torch.where(top > 0, top, 1.0)
    shift = unit * (torch.where(even, -1.25, 1.25) + torch.where(padding, 1.75, 0.0)).to(evals.dtype)
    block = even.long() + 2 * padding
    laplacian = vectors.mT @ (evals[..., None] * vectors)
    laplacian = torch.where(block[..., :, None] == block[..., None, :], laplacian, 0.0) + torch.diag_embed(shift)
    shifted, rotation = invariant_eigh(laplacian, rtol, top[..., 0])
    coeffs = vectors @ rotation
    # Rayleigh quotients have the value without the rounding of the shift, and are never below the least eigenvalue: a
    # root of an eigenvalue 0 stays real. The gradient is that of `shifted`.
    quotients = (coeffs.detach().square() * evals.detach()[..., None]).sum(-2)
    values = quotients + (shifted - shifted.detach())
    is_even = place < n_even
    is_odd = (place >= n_even) & (place < n)
    if k_even is None:
        k_even = int(n_even.amax()) if n_even.numel() else 0  # of no shape at all
    if k_odd is None:
        k_odd = int((n - n_even).amax()) if n.numel() else 0
    evals_even, coeffs_even, even_mask = _lowest(values, coeffs, is_even, k_even)
    evals_odd, coeffs_odd, odd_mask = _lowest(values, coeffs, is_odd, k_odd)
    return SplitBases(
        *(evals_even, evecs @ coeffs_even, coeffs_even, even_mask),
        *(evals_odd, evecs @ coeffs_odd, coeffs_odd, odd_mask),
        halves.spectrum,
        mass,
    )


def _lowest(values: Tensor, coeffs: Tensor, chosen: Tensor, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """The chosen columns with the ``k`` lowest values, in ascending order, signs fixed, then zeros."""
    order = torch.where(chosen, values.detach(), torch.inf).argsort(stable=True, dim=-1)[..., :k]
    mask = torch.gather(chosen, -1, order)
    values = torch.where(mask, torch.gather(values, -1, order), 0.0)
    columns = torch.gather(coeffs, -1, order[..., None, :].expand(*coeffs.shape[:-1], order.shape[-1]))
    columns = torch.where(mask[..., None, :], columns, 0.0)
    if columns.shape[-1]:
        columns = columns * column_signs(columns)
    missing = k - order.shape[-1]
    if missing > 0:
        values, columns, mask = pad(values, (0, missing)), pad(columns, (0, missing)), pad(mask, (0, missing))
    return values, columns, mask


def _check_numbers(sizes: Sizes, evals: Tensor, k_even: int | None, k_odd: int | None) -> None:
    sizes.bind("evals", evals, "... K")
    require_finite("evals", evals)
    for name, k in (("k_even", k_even), ("k_odd", k_odd)):
        if k is not None and k < 0:
            raise ValueError(f"{name} is {k}: allowed are 0 and more, or None for the batch's largest")
