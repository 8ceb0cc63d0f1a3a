"""Refinement of functional maps with soft partners: the iterations of the classical refinement, differentiable.

With a temperature that goes to zero these are :func:`torchqm.fmap.refine.quotient_icp` and
:func:`~torchqm.fmap.refine.upsample`.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.checks import Sizes, require_finite, require_mask, require_nonnegative
from torchqm.fmap.polar import nearest_isometry
from torchqm.fmap.soft import soft_map
from torchqm.spectral.soft_map import SoftMap

__all__ = ["soft_icp", "soft_upsample"]

FMap = Float[Tensor, "*B Ky Kx"]


def soft_icp(
    fmap_xy: FMap,
    evecs_x: Float[Tensor, "*B X Kx"],
    evecs_y: Float[Tensor, "*B Y Ky"],
    steps: int = 5,
    tau: float | Float[Tensor, ""] = 0.02,
    neighbours: int | None = None,
    weights_x: Float[Tensor, "*B X"] | None = None,
    verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
    evals_mask_x: Bool[Tensor, "*B Kx"] | None = None,
    evals_mask_y: Bool[Tensor, "*B Ky"] | None = None,
) -> FMap:
    """Iterate: soft partners of the deltas of x, then the isometry nearest to their correspondence matrix.

    ``Pi(x, y) = softmax_y(-|| C delta_x - delta_y ||^2 / (Ky tau))`` and ``C <- polar(sum_x a_x (Pi delta_y)(x)
    delta_x^T)``. Deltas in even bases make it quotient-ICP, in full ones ICP, and from a full to an even one
    semi-quotient ICP.

    Args:
        fmap_xy: ``(..., Ky, Kx)`` initial map, functions on x to functions on y.
        evecs_x: ``(..., X, Kx)`` basis of x at its samples (rows).
        evecs_y: ``(..., Y, Ky)`` basis of y at the vertices that are searched.
        steps: number of iterations; 0 returns the input.
        tau: temperature, in mean squares of a basis function on a shape of area one. Zero is not allowed.
        neighbours: how many partners share the weight of one point; all of them by default, in ``X x Y`` memory.
        weights_x: ``(..., X)`` areas that the samples stand for, not negative; all the same by default. Padded samples
            get 0.
        verts_mask_y: ``(..., Y)`` true where a vertex of y is real.
        evals_mask_x: ``(..., Kx)`` true where a function of x is real; padded functions are zero, and stay so.
        evals_mask_y: ``(..., Ky)`` likewise on y.

    Returns:
        The refined map, of the same shape.

    Raises:
        ValueError: sizes that do not fit, ``steps`` negative, ``tau`` not positive, non-finite input.

    Example:
        >>> basis = torch.tensor([[1.0, 1.0], [1.0, -1.0]])
        >>> soft_icp(torch.eye(2) + 0.1, basis, basis).round(decimals=3).tolist()
        [[1.0, 0.0], [0.0, 1.0]]

    References:
        Paper, section 4.3, Quotient-ICP, and section 5.
    """
    sizes = _checked(fmap_xy, evecs_x, evecs_y, steps, tau, neighbours, weights_x, verts_mask_y)
    mask = None
    count: int | Tensor = sizes["Ky"]
    if evals_mask_x is not None or evals_mask_y is not None:
        ones = fmap_xy.new_ones(1, dtype=torch.bool)
        if evals_mask_x is not None:
            sizes.bind("evals_mask_x", evals_mask_x, "... Kx")
            require_mask("evals_mask_x", evals_mask_x)
        if evals_mask_y is not None:
            sizes.bind("evals_mask_y", evals_mask_y, "... Ky")
            require_mask("evals_mask_y", evals_mask_y)
            count = evals_mask_y.sum(-1).to(fmap_xy.dtype)[..., None, None]
        mask = (ones if evals_mask_y is None else evals_mask_y)[..., :, None] & (
            ones if evals_mask_x is None else evals_mask_x
        )[..., None, :]
    for _ in range(steps):
        sizes_yx = _sizes_of(fmap_xy)
        fmap_xy = _step(fmap_xy, evecs_x, evecs_y, *sizes_yx, tau, neighbours, weights_x, verts_mask_y, count)
        if mask is not None:
            fmap_xy = torch.where(mask, fmap_xy, 0.0)
    return fmap_xy


def soft_upsample(
    fmap_xy: FMap,
    evecs_x: Float[Tensor, "*B X Lx"],
    evecs_y: Float[Tensor, "*B Y Ly"],
    sizes: Sequence[int],
    steps: int = 1,
    tau: float | Float[Tensor, ""] = 0.02,
    neighbours: int | None = None,
    weights_x: Float[Tensor, "*B X"] | None = None,
    verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
) -> Float[Tensor, "*B L L"]:
    """Spectral upsampling with soft partners: matched at one size, read off at the next; see :func:`soft_icp`.

    Args:
        fmap_xy: ``(..., Ky, Kx)`` initial map between the first functions of the two bases.
        evecs_x: ``(..., X, Lx)`` basis of x at its samples, with at least ``max(sizes)`` functions.
        evecs_y: ``(..., Y, Ly)`` basis of y, likewise.
        sizes: numbers of functions, one after the other.
        steps: iterations at each size.
        tau: as in :func:`soft_icp`.
        neighbours: likewise.
        weights_x: likewise.
        verts_mask_y: likewise.

    Returns:
        The map at the last size; the input, if there are no sizes.

    Raises:
        ValueError: as :func:`soft_icp`, and for a size that a basis does not have.

    References:
        Paper, section 7.4; Melzi et al. 2019.
    """
    if steps < 1:
        raise ValueError(f"steps={steps}: each size needs at least one iteration")
    ky, kx = fmap_xy.shape[-2:]
    largest = min(evecs_x.shape[-1], evecs_y.shape[-1])
    wrong = [size for size in sizes if not 1 <= size <= largest]
    if wrong:
        raise ValueError(
            f"sizes: {wrong} given, but the bases have {evecs_x.shape[-1]} and {evecs_y.shape[-1]} functions"
        )
    if kx > evecs_x.shape[-1] or ky > evecs_y.shape[-1]:
        raise ValueError(
            f"fmap_xy: shape ({ky}, {kx}) given, but the bases have {evecs_y.shape[-1]} and "
            f"{evecs_x.shape[-1]} functions"
        )
    _checked(fmap_xy, evecs_x[..., :kx], evecs_y[..., :ky], steps, tau, neighbours, weights_x, verts_mask_y)
    for size in sizes:
        for _ in range(steps):
            fmap_xy = _step(fmap_xy, evecs_x, evecs_y, size, size, tau, neighbours, weights_x, verts_mask_y)
    return fmap_xy


def _sizes_of(fmap_xy: Tensor) -> tuple[int, int]:
    return fmap_xy.shape[-2], fmap_xy.shape[-1]


def _step(
    fmap_xy: Tensor,
    evecs_x: Tensor,
    evecs_y: Tensor,
    size_y: int,
    size_x: int,
    tau: float | Tensor,
    neighbours: int | None,
    weights_x: Tensor | None,
    verts_mask_y: Tensor | None,
    count: int | Tensor | None = None,
) -> Tensor:
    ky, kx = _sizes_of(fmap_xy)
    scale = (ky if count is None else count) ** -0.5  # so that a squared distance is the mean over the functions
    images = evecs_x[..., :kx] @ fmap_xy.mT
    soft = soft_map(scale * images, scale * evecs_y[..., :ky], tau, neighbours, mask_y=verts_mask_y, kind="distance")
    target = evecs_y[..., :size_y]
    partners = soft.apply(target) if isinstance(soft, SoftMap) else soft @ target
    source = evecs_x[..., :size_x]
    return nearest_isometry(partners.mT @ (source if weights_x is None else source * weights_x[..., None]))


def _checked(
    fmap_xy: Tensor,
    evecs_x: Tensor,
    evecs_y: Tensor,
    steps: int,
    tau: float | Tensor,
    neighbours: int | None,
    weights_x: Tensor | None,
    verts_mask_y: Tensor | None,
) -> Sizes:
    if steps < 0:
        raise ValueError(f"steps={steps}: the number of iterations must not be negative")
    if not isinstance(tau, Tensor) and tau <= 0:
        raise ValueError(f"tau={tau}: the temperature must be positive; the limit of zero is quotient_icp")
    sizes = Sizes()
    sizes.bind("fmap_xy", fmap_xy, "... Ky Kx")
    sizes.bind("evecs_x", evecs_x, "... X Kx")
    sizes.bind("evecs_y", evecs_y, "... Y Ky")
    if weights_x is not None:
        sizes.bind("weights_x", weights_x, "... X")
        require_nonnegative("weights_x", weights_x)
        require_mask("weights_x > 0", weights_x > 0)
    if verts_mask_y is not None:
        sizes.bind("verts_mask_y", verts_mask_y, "... Y")
        require_mask("verts_mask_y", verts_mask_y)
    if neighbours is not None and not 1 <= neighbours <= sizes["Y"]:
        raise ValueError(f"neighbours={neighbours}: of {sizes['Y']} vertices 1..{sizes['Y']} can be partners")
    for name, tensor in (("fmap_xy", fmap_xy), ("evecs_x", evecs_x), ("evecs_y", evecs_y)):
        require_finite(name, tensor)
    return sizes
