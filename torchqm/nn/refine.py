"""Layers that refine a functional map by unrolled iterations, with gradients through all of them."""

from collections.abc import Sequence
from math import log

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchqm.fmap.unrolled import soft_icp, soft_upsample
from torchqm.options import require_counts, require_flag, require_number, require_whole

__all__ = ["QuotientICP", "SpectralUpsampling"]


class _Refinement(nn.Module):
    """What the two have in common: a temperature, which may be learned, and how many partners a point has."""

    def __init__(self, steps: int, tau: float, learn_tau: bool, neighbours: int | None) -> None:
        super().__init__()
        require_number("tau", tau, above=0)
        require_flag("learn_tau", learn_tau)
        require_whole("neighbours", neighbours, optional=True)
        self.steps, self.neighbours = steps, neighbours
        self._fixed = tau
        self.log_tau = nn.Parameter(torch.tensor(log(tau))) if learn_tau else None

    def _tau(self, like: Tensor) -> float | Tensor:
        return self._fixed if self.log_tau is None else self.log_tau.exp().to(like.dtype)

    def _shown(self) -> float:
        return self._fixed if self.log_tau is None else float(self.log_tau.detach().exp())

    def extra_repr(self) -> str:
        """What ``print`` shows."""
        return f"steps={self.steps}, tau={self._shown():.3g}, neighbours={self.neighbours}"


class QuotientICP(_Refinement):
    """Quotient-ICP with soft partners; see :func:`torchqm.fmap.unrolled.soft_icp`.

    Args:
        steps: number of iterations.
        tau: temperature of the soft partners, in mean squares of a basis function on a shape of area one.
        learn_tau: whether it is a parameter.
        neighbours: how many partners share the weight of one point; all by default.

    References:
        Paper, section 4.3, Quotient-ICP.
    """

    def __init__(
        self, steps: int = 5, tau: float = 0.02, learn_tau: bool = False, neighbours: int | None = None
    ) -> None:
        require_whole("steps", steps, 0)
        super().__init__(steps, tau, learn_tau, neighbours)

    def forward(
        self,
        fmap_xy: Float[Tensor, "*B Ky Kx"],
        evecs_x: Float[Tensor, "*B X Kx"],
        evecs_y: Float[Tensor, "*B Y Ky"],
        mass_x: Float[Tensor, "*B X"] | None = None,
        verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
        evals_mask_x: Bool[Tensor, "*B Kx"] | None = None,
        evals_mask_y: Bool[Tensor, "*B Ky"] | None = None,
    ) -> Float[Tensor, "*B Ky Kx"]:
        """The refined map ``(B, Ky, Kx)``; even bases for a map on the quotient.

        ``mass_x`` weights the vertices of x (padding has none).
        """
        return soft_icp(
            fmap_xy,
            evecs_x,
            evecs_y,
            self.steps,
            self._tau(fmap_xy),
            self.neighbours,
            mass_x,
            verts_mask_y,
            evals_mask_x,
            evals_mask_y,
        )


class SpectralUpsampling(_Refinement):
    """Growing bases with soft partners; see :func:`torchqm.fmap.unrolled.soft_upsample`.

    Args:
        sizes: numbers of functions, one after the other, e.g. of :func:`torchqm.fmap.growing_sizes`.
        steps: iterations at each.
        tau: temperature, as in :class:`QuotientICP`.
        learn_tau: whether it is a parameter.
        neighbours: how many partners share the weight of one point; all by default.

    References:
        Paper, section 7.4; Melzi et al. 2019.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        steps: int = 1,
        tau: float = 0.02,
        learn_tau: bool = False,
        neighbours: int | None = None,
    ) -> None:
        require_whole("steps", steps)
        super().__init__(steps, tau, learn_tau, neighbours)
        self.sizes = require_counts("sizes", sizes)

    def forward(
        self,
        fmap_xy: Float[Tensor, "*B Ky Kx"],
        evecs_x: Float[Tensor, "*B X Lx"],
        evecs_y: Float[Tensor, "*B Y Ly"],
        mass_x: Float[Tensor, "*B X"] | None = None,
        verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
        evals_mask_x: Bool[Tensor, "*B Lx"] | None = None,
        evals_mask_y: Bool[Tensor, "*B Ly"] | None = None,
    ) -> Float[Tensor, "*B L L"]:
        """The map at the last of the sizes, 0 at padded functions.

        In a batch of shapes with different numbers of functions the masks say which are real: a shape that has less
        than a size takes part with all of its own.
        """
        return soft_upsample(
            fmap_xy,
            evecs_x,
            evecs_y,
            self.sizes,
            self.steps,
            self._tau(fmap_xy),
            self.neighbours,
            mass_x,
            verts_mask_y,
            evals_mask_x,
            evals_mask_y,
        )

    def extra_repr(self) -> str:
        """What ``print`` shows."""
        return f"sizes={self.sizes}, {super().extra_repr()}"
