"""Layers for intrinsic descriptors with learnable energies, times and widths, and for odd ones from pairs of even."""

from math import log, pi

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchqm.checks import Sizes, require_finite, require_ids, require_mask, require_nonnegative
from torchqm.options import require_flag, require_number, require_whole
from torchqm.spectral.descriptors import WaveEnergies, heat_kernel_values, wave_kernel_values
from torchqm.symmetry.orientation import function_pairs, orientation_descriptors

__all__ = ["HeatKernelSignature", "OrientationDescriptors", "WaveKernelSignature"]


class WaveKernelSignature(nn.Module):
    """``WKS(x, e) = sum_k phi_k(x)^2 g(e - log lambda_k) / sum_k g(e - log lambda_k)``, energies and widths learnable.

    Everything is scaled to total area one first, so that signatures of shapes of any size compare. Without given
    ``energies`` they lie between the first and the ``k``-th eigenvalue that Weyl's law predicts for that area
    (``lambda_k = 4 pi k``), with the margins and the width of Aubry et al.

    Args:
        n: number of energies.
        k: eigenfunctions of the bases that will be given, for the range of the energies.
        learnable: whether energies and widths are parameters (else buffers).
        energies: where to start, e.g. from :func:`torchqm.spectral.wave_energies` on shapes of area one.

    Example:
        >>> layer = WaveKernelSignature(n=4, k=3)
        >>> evals, evecs = torch.tensor([[0.0, 20.0, 30.0]]), torch.ones(1, 5, 3)
        >>> layer(evals, evecs, torch.full((1, 5), 0.2)).shape
        torch.Size([1, 5, 4])

    References:
        Aubry, Schlickewei and Cremers 2011; paper, section 4.1.
    """

    log_energies: Tensor
    log_sigma: Tensor

    def __init__(
        self, n: int = 128, k: int = 128, learnable: bool = True, energies: WaveEnergies | None = None
    ) -> None:
        super().__init__()
        if energies is None:
            require_whole("n", n, 2)
            require_whole("k", k, 3)
            low, high = log(4 * pi), log(4 * pi * (k - 1))
            sigma = 7 * (high - low) / (n + 28)
            energies = WaveEnergies(torch.linspace(low + 2 * sigma, high - 2 * sigma, n), sigma)
        require_number("energies.sigma", energies.sigma, above=0)
        start = _row("energies.log_energies", energies.log_energies)
        _learn(self, learnable, log_energies=start.clone(), log_sigma=torch.full_like(start, log(energies.sigma)))

    def forward(
        self,
        evals: Float[Tensor, "*B K"],
        evecs: Float[Tensor, "*B V K"],
        mass: Float[Tensor, "*B V"],
        evals_mask: Bool[Tensor, "*B K"] | None = None,
    ) -> Float[Tensor, "*B V n"]:
        """Signatures ``(B, V, n)`` of bases ``(B, K), (B, V, K)`` with vertex areas ``(B, V)``; padding gives zero.

        Raises:
            ValueError: sizes that do not fit, fewer than 3 functions, negative mass, non-finite values.
        """
        area = _checked_area(evals, evecs, mass, evals_mask)
        energies, sigma = self.log_energies.to(evals.dtype), self.log_sigma.exp().to(evals.dtype)
        return wave_kernel_values(evals * area, evecs * area[..., None].sqrt(), energies, sigma, evals_mask=evals_mask)

    def extra_repr(self) -> str:
        """What ``print`` shows."""
        return f"n={self.log_energies.shape[0]}"


class HeatKernelSignature(nn.Module):
    """``HKS(x, t) = sum_k exp(-lambda_k t) phi_k(x)^2 / sum_k exp(-lambda_k t)`` with learnable times.

    Scaled to total area one, as :class:`WaveKernelSignature`. Times start evenly in the logarithm between
    ``4 ln 10 / lambda_k`` and ``4 ln 10 / lambda_1`` of Weyl's law.

    Args:
        n: number of times.
        k: eigenfunctions of the bases that will be given.
        learnable: whether the times are parameters (else buffers).
        times: ``(n,)`` where to start, for shapes of area one.

    References:
        Sun, Ovsjanikov and Guibas 2009.
    """

    log_times: Tensor

    def __init__(
        self, n: int = 128, k: int = 128, learnable: bool = True, times: Float[Tensor, " n"] | None = None
    ) -> None:
        super().__init__()
        if times is None:
            require_whole("n", n)
            require_whole("k", k, 3)
            scale = log(4 * log(10))
            times = torch.linspace(scale - log(4 * pi * (k - 1)), scale - log(4 * pi), n).exp()
        times = _row("times", times)
        require_nonnegative("times", times)
        _learn(self, learnable, log_times=times.clamp_min(1e-30).log())

    def forward(
        self,
        evals: Float[Tensor, "*B K"],
        evecs: Float[Tensor, "*B V K"],
        mass: Float[Tensor, "*B V"],
        evals_mask: Bool[Tensor, "*B K"] | None = None,
    ) -> Float[Tensor, "*B V n"]:
        """Signatures ``(B, V, n)``; arguments and errors as for :meth:`WaveKernelSignature.forward`."""
        area = _checked_area(evals, evecs, mass, evals_mask)
        times = self.log_times.exp().to(evals.dtype)
        return heat_kernel_values(evals * area, evecs * area[..., None].sqrt(), times, evals_mask)

    def extra_repr(self) -> str:
        """What ``print`` shows."""
        return f"n={self.log_times.shape[0]}"


class OrientationDescriptors(nn.Module):
    """Odd descriptors from pairs of even features: ``omega(f_a, f_b) = n . (grad f_a x grad f_b)``.

    Features that are equal left and right say nothing about the odd half of a map; these do, and their sign is that of
    the orientation-preserving map. Give them to :class:`torchqm.nn.FunctionalMapSolver` for the odd block.

    Args:
        n_features: C, how many features there are.
        n_pairs: how many pairs to take; all ``C (C - 1) / 2`` if not given, else a fixed draw (``seed``).
        seed: of the draw.

    Example:
        >>> layer = OrientationDescriptors(4)
        >>> layer.pairs.shape
        torch.Size([2, 6])
    """

    pairs: Int[Tensor, "2 P"]

    def __init__(self, n_features: int, n_pairs: int | None = None, seed: int = 0) -> None:
        super().__init__()
        require_whole("n_features", n_features, 2)
        require_whole("n_pairs", n_pairs, optional=True)
        require_whole("seed", seed, least=None)
        pairs = function_pairs(n_features + 1) - 1  # here no function is the constant one
        if n_pairs is not None:
            if n_pairs > pairs.shape[1]:
                raise ValueError(f"n_pairs: {n_pairs} given, but {n_features} features make 1..{pairs.shape[1]} pairs")
            drawn = torch.randperm(pairs.shape[1], generator=torch.Generator().manual_seed(seed))[:n_pairs]
            pairs = pairs[:, drawn.sort().values]
        self.n_features = n_features
        self.register_buffer("pairs", pairs)

    def forward(
        self, feat: Float[Tensor, "*B V C"], faces: Int[Tensor, "*B F 3"], mass: Float[Tensor, "*B V"]
    ) -> Float[Tensor, "*B V P"]:
        """Odd descriptors ``(B, V, P)`` of features ``(B, V, C)`` on triangles ``(B, F, 3)``.

        Raises:
            ValueError: sizes that do not fit, negative mass, non-finite features, ids out of range.
        """
        sizes = Sizes()
        sizes.bind("feat", feat, f"... V {self.n_features}")
        sizes.bind("faces", faces, "... F 3")
        sizes.bind("mass", mass, "... V")
        require_finite("feat", feat)
        require_nonnegative("mass", mass)
        require_ids("faces", faces, sizes["V"])
        return orientation_descriptors(feat, faces, mass, self.pairs)

    def extra_repr(self) -> str:
        """What ``print`` shows."""
        return f"n_features={self.n_features}, n_pairs={self.pairs.shape[1]}"


def _row(name: str, values: Tensor) -> Tensor:
    """Numbers to begin with, in the dtype of parameters."""
    Sizes().bind(name, values, "n")
    if not values.numel():
        raise ValueError(f"{name}: no number given, expected at least one")
    values = values.to(torch.get_default_dtype())
    require_finite(name, values)
    return values


def _learn(layer: nn.Module, learnable: bool, **values: Tensor) -> None:
    require_flag("learnable", learnable)
    for name, value in values.items():
        if learnable:
            layer.register_parameter(name, nn.Parameter(value))
        else:
            layer.register_buffer(name, value)


def _checked_area(evals: Tensor, evecs: Tensor, mass: Tensor, evals_mask: Tensor | None) -> Tensor:
    """The total area ``(..., 1)``, after checks of everything."""
    sizes = Sizes()
    sizes.bind("evecs", evecs, "... V K")
    sizes.bind("evals", evals, "... K")
    sizes.bind("mass", mass, "... V")
    if sizes["K"] < 3:
        raise ValueError(f"evecs: {sizes['K']} functions given; a signature needs at least 3")
    if evals_mask is not None:
        sizes.bind("evals_mask", evals_mask, "... K")
        require_mask("evals_mask[..., 1:], the functions that are not constant", evals_mask[..., 1:])
    require_finite("evals", evals)
    require_finite("evecs", evecs)
    require_nonnegative("mass", mass)
    area = mass.sum(-1, keepdim=True)
    require_mask("mass > 0", mass > 0)
    return area
