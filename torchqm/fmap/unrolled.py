"""Refinement of functional maps with soft partners: the iterations of the classical refinement, differentiable.

With a temperature that goes to zero these are :func:`torchqm.fmap.refine.quotient_icp` and
:func:`~torchqm.fmap.refine.upsample`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.checks import Sizes, require_finite, require_mask, require_nonnegative
from torchqm.fmap.polar import nearest_isometry
from torchqm.fmap.soft import soft_map
from torchqm.options import require_counts, require_number, require_whole
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
    mass_x: Float[Tensor, "*B X"] | None = None,
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
        mass_x: ``(..., X)`` areas that the samples stand for, not negative; all the same by default. Padded samples
            get 0.
        verts_mask_y: ``(..., Y)`` true where a vertex of y is real.
        evals_mask_x: ``(..., Kx)`` true where a function of x is real; padded ones may hold anything finite and
            the map is 0 there.
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
    _checked(fmap_xy, evecs_x, evecs_y, steps, tau, neighbours, mass_x, verts_mask_y)
    masks = _Masks(evals_mask_x, evals_mask_y)
    masks.check(evecs_x, evecs_y, *fmap_xy.shape[-2:])
    fmap_xy, evecs_x, evecs_y = masks.without_padding(fmap_xy, evecs_x, evecs_y)
    size_y, size_x = fmap_xy.shape[-2:]
    for _ in range(steps):
        fmap_xy = _step(fmap_xy, evecs_x, evecs_y, size_y, size_x, tau, neighbours, mass_x, verts_mask_y, masks)
    return fmap_xy


def soft_upsample(
    fmap_xy: FMap,
    evecs_x: Float[Tensor, "*B X Lx"],
    evecs_y: Float[Tensor, "*B Y Ly"],
    sizes: Sequence[int],
    steps: int = 1,
    tau: float | Float[Tensor, ""] = 0.02,
    neighbours: int | None = None,
    mass_x: Float[Tensor, "*B X"] | None = None,
    verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
    evals_mask_x: Bool[Tensor, "*B Lx"] | None = None,
    evals_mask_y: Bool[Tensor, "*B Ly"] | None = None,
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
        mass_x: likewise.
        verts_mask_y: likewise.
        evals_mask_x: ``(..., Lx)`` true where a function of x is real. Shapes of a batch may have different numbers of
            functions: at a size that is more than a shape has, it takes part with all of its own.
        evals_mask_y: ``(..., Ly)`` likewise on y.

    Returns:
        The map at the last size; the input, if there are no sizes. 0 at padded functions.

    Raises:
        ValueError: as :func:`soft_icp`, and for a size that a basis does not have, padding included.

    Example:
        >>> basis = torch.tensor([[1.0, 1.0], [1.0, -1.0]])
        >>> soft_upsample(torch.ones(1, 1), basis, basis, [2], evals_mask_y=torch.tensor([True, False])).tolist()
        [[1.0, 0.0], [0.0, 0.0]]

    References:
        Paper, section 7.4; Melzi et al. 2019.
    """
    require_whole("steps", steps)
    sizes = require_counts("sizes", sizes)
    ky, kx = fmap_xy.shape[-2:]
    largest = min(evecs_x.shape[-1], evecs_y.shape[-1])
    wrong = [size for size in sizes if size > largest]
    if wrong:
        raise ValueError(
            f"sizes: {wrong} given, but the bases have {evecs_x.shape[-1]} and {evecs_y.shape[-1]} functions"
        )
    if kx > evecs_x.shape[-1] or ky > evecs_y.shape[-1]:
        raise ValueError(
            f"fmap_xy: shape ({ky}, {kx}) given, but the bases have {evecs_y.shape[-1]} and "
            f"{evecs_x.shape[-1]} functions"
        )
    _checked(fmap_xy, evecs_x[..., :kx], evecs_y[..., :ky], steps, tau, neighbours, mass_x, verts_mask_y)
    masks = _Masks(evals_mask_x, evals_mask_y)
    masks.check(evecs_x, evecs_y, min(ky, *sizes) if sizes else ky, min(kx, *sizes) if sizes else kx)
    fmap_xy, evecs_x, evecs_y = masks.without_padding(fmap_xy, evecs_x, evecs_y)
    for size in sizes:
        for _ in range(steps):
            fmap_xy = _step(fmap_xy, evecs_x, evecs_y, size, size, tau, neighbours, mass_x, verts_mask_y, masks)
    return fmap_xy


class _Masks(NamedTuple):
    """Which functions of two bases are real; None: all."""

    x: Tensor | None
    y: Tensor | None

    def check(self, evecs_x: Tensor, evecs_y: Tensor, least_y: int, least_x: int) -> None:
        """Sizes, and a real function among the first ones of each shape."""
        for side, mask, evecs, least in (("x", self.x, evecs_x, least_x), ("y", self.y, evecs_y, least_y)):
            if mask is not None:
                sizes = Sizes()
                sizes.bind(f"evecs_{side}", evecs, "... V K")
                sizes.bind(f"evals_mask_{side}", mask, "... K")
                part = "" if least == mask.shape[-1] else f"[..., :{least}]"
                require_mask(f"evals_mask_{side}{part}", mask[..., :least])

    def without_padding(self, fmap_xy: Tensor, evecs_x: Tensor, evecs_y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The three with zeros at padded functions, so that whatever stands there has no say."""
        evecs_x, evecs_y = (
            evecs if mask is None else torch.where(mask[..., None, :], evecs, 0.0)
            for evecs, mask in ((evecs_x, self.x), (evecs_y, self.y))
        )
        return self.of_map(fmap_xy), evecs_x, evecs_y

    def of_map(self, fmap_xy: Tensor) -> Tensor:
        """A map between the first functions with zeros at padded ones."""
        ky, kx = fmap_xy.shape[-2:]
        if self.x is not None:
            fmap_xy = torch.where(self.x[..., None, :kx], fmap_xy, 0.0)
        if self.y is not None:
            fmap_xy = torch.where(self.y[..., :ky, None], fmap_xy, 0.0)
        return fmap_xy

    def count_y(self, like: Tensor, size: int) -> int | Tensor:
        """How many of the first functions of y are real."""
        return size if self.y is None else self.y[..., :size].sum(-1).to(like.dtype)[..., None, None]


def _step(
    fmap_xy: Tensor,
    evecs_x: Tensor,
    evecs_y: Tensor,
    size_y: int,
    size_x: int,
    tau: float | Tensor,
    neighbours: int | None,
    mass_x: Tensor | None,
    verts_mask_y: Tensor | None,
    masks: _Masks,
) -> Tensor:
    ky, kx = fmap_xy.shape[-2:]
    scale = masks.count_y(fmap_xy, ky) ** -0.5  # so that a squared distance is the mean over the functions
    images = evecs_x[..., :kx] @ fmap_xy.mT
    soft = soft_map(scale * images, scale * evecs_y[..., :ky], tau, neighbours, mask_y=verts_mask_y, kind="distance")
    target = evecs_y[..., :size_y]
    partners = soft.apply(target) if isinstance(soft, SoftMap) else soft @ target
    source = evecs_x[..., :size_x]
    matched = partners.mT @ (source if mass_x is None else source * mass_x[..., None])
    return masks.of_map(nearest_isometry(matched))  # of the rows and columns of padding it makes anything


def _checked(
    fmap_xy: Tensor,
    evecs_x: Tensor,
    evecs_y: Tensor,
    steps: int,
    tau: float | Tensor,
    neighbours: int | None,
    mass_x: Tensor | None,
    verts_mask_y: Tensor | None,
) -> Sizes:
    require_whole("steps", steps, 0)
    if not isinstance(tau, Tensor):  # of a tensor the value is looked at by soft_map
        require_number("tau", tau, above=0)
    require_whole("neighbours", neighbours, optional=True)
    sizes = Sizes()
    sizes.bind("fmap_xy", fmap_xy, "... Ky Kx")
    sizes.bind("evecs_x", evecs_x, "... X Kx")
    sizes.bind("evecs_y", evecs_y, "... Y Ky")
    if mass_x is not None:
        sizes.bind("mass_x", mass_x, "... X")
        require_nonnegative("mass_x", mass_x)
        require_mask("mass_x > 0", mass_x > 0)
    if verts_mask_y is not None:
        sizes.bind("verts_mask_y", verts_mask_y, "... Y")
        require_mask("verts_mask_y", verts_mask_y)
    if neighbours is not None and neighbours > sizes["Y"]:
        raise ValueError(
            f"neighbours: {neighbours} given, but y has {sizes['Y']} vertices, so 1..{sizes['Y']} is allowed"
        )
    for name, tensor in (("fmap_xy", fmap_xy), ("evecs_x", evecs_x), ("evecs_y", evecs_y)):
        require_finite(name, tensor)
    return sizes
