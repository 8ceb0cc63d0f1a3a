"""Intrinsic descriptors (WKS, HKS) and the splitting that raises their rank (paper, section 4.1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.spectral.basis import SpectralBasis

__all__ = [
    "WaveEnergies",
    "heat_kernel_signature",
    "heat_kernel_values",
    "heat_times",
    "split_descriptors",
    "unit_columns",
    "wave_energies",
    "wave_kernel_signature",
    "wave_kernel_values",
]

Values = Float[Tensor, "_V C"]  # the shapes of a list may have different numbers of vertices


@dataclass(frozen=True)
class WaveEnergies:
    """Where the wave kernel signature looks: ``n`` log energies and the width of its band-pass.

    Args:
        log_energies: ``(n,)`` ascending, natural logarithm of an eigenvalue.
        sigma: standard deviation of the band-pass, in the same logarithmic unit.
    """

    log_energies: Float[Tensor, " n"]
    sigma: float


def wave_energies(bases: Sequence[SpectralBasis], n: int = 100) -> WaveEnergies:
    """One energy range for all the given shapes, by the rule of Aubry et al. 2011.

    ``sigma = 7 delta``, ``e_min = log E_1 + 2 sigma``, ``e_max = log E_K - 2 sigma`` with
    ``delta = (e_max - e_min) / n``, hence ``sigma = 7 (log E_K - log E_1) / (n + 28)``. ``E_1`` and ``E_K`` are
    geometric means over the shapes: signatures are only comparable when both shapes are asked at the same energies.
    The bases must have the same area.

    Raises:
        ValueError: fewer than two energies, a basis with fewer than three functions, or a second eigenvalue of zero.
    """
    if n < 2:
        raise ValueError(f"n={n}: the wave kernel signature needs at least 2 energies")
    low, high = _log_range(bases)
    sigma = 7 * (high - low) / (n + 28)
    return WaveEnergies(torch.linspace(low + 2 * sigma, high - 2 * sigma, n, dtype=torch.float64), sigma)


def wave_kernel_signature(basis: SpectralBasis, energies: WaveEnergies) -> Float[Tensor, "V n"]:
    """``WKS(x, e) = sum_k phi_k(x)^2 g(e - log lambda_k) / sum_k g(e - log lambda_k)``, ``g`` Gaussian of width sigma.

    Returns:
        ``(V, n)`` values in 1 / area.

    References:
        Aubry, Schlickewei and Cremers 2011; paper, section 4.1 and 7.4.
    """
    return wave_kernel_values(basis.evals, basis.evecs, energies.log_energies, energies.sigma)


def wave_kernel_values(
    evals: Float[Tensor, "*B K"],
    evecs: Float[Tensor, "*B V K"],
    log_energies: Float[Tensor, " n"],
    sigma: float | Float[Tensor, " n"],
    evals_mask: Bool[Tensor, "*B K"] | None = None,
) -> Float[Tensor, "*B V n"]:
    """:func:`wave_kernel_signature` of a batch, differentiable in all that it is given.

    Args:
        evals: ``(..., K)`` ascending; the first function, the constant one, is left out.
        evecs: ``(..., V, K)``.
        log_energies: ``(n,)`` natural logarithms of eigenvalues.
        sigma: width of the band-pass, one for all energies or one each (logarithmic unit).
        evals_mask: ``(..., K)`` true where a function is real, not padding.
    """
    logs = evals[..., 1:].clamp_min(_tiny(evals)).log()
    width = torch.as_tensor(sigma, dtype=log_energies.dtype, device=log_energies.device)
    scores = -((log_energies - logs[..., :, None]) ** 2) / (2 * width**2)
    if evals_mask is not None:
        scores = scores.masked_fill(~evals_mask[..., 1:, None], -torch.inf)
    return evecs[..., 1:].square() @ torch.softmax(scores, dim=-2).to(evecs.dtype)


def heat_times(bases: Sequence[SpectralBasis], n: int = 100) -> Float[Tensor, " n"]:
    """Log-spaced times ``4 ln 10 / lambda_K .. 4 ln 10 / lambda_1`` (area), shared by all shapes (Sun et al. 2009).

    Raises:
        ValueError: no diffusion time, a basis with fewer than three functions, or a second eigenvalue of zero.
    """
    if n < 1:
        raise ValueError(f"n={n}: at least one diffusion time is needed")
    low, high = _log_range(bases)
    scale = log(4 * log(10))
    return torch.linspace(scale - high, scale - low, n, dtype=torch.float64).exp()


def _log_range(bases: Sequence[SpectralBasis]) -> tuple[float, float]:
    """Mean logarithm of the second and of the last eigenvalue."""
    if any(b.k < 3 for b in bases) or not bases:
        raise ValueError(f"bases: each needs at least 3 functions, given {[b.k for b in bases]}")
    if any(float(b.evals[1]) <= 0 for b in bases):
        second = [float(b.evals[1]) for b in bases]
        raise ValueError(f"bases: second eigenvalues {second}; zero means that a shape has several components")
    low = sum(log(float(b.evals[1])) for b in bases) / len(bases)
    high = sum(log(float(b.evals[-1])) for b in bases) / len(bases)
    return low, high


def heat_kernel_signature(basis: SpectralBasis, times: Float[Tensor, " n"]) -> Float[Tensor, "V n"]:
    """``HKS(x, t) = sum_k exp(-lambda_k t) phi_k(x)^2``, divided by the heat trace ``sum_k exp(-lambda_k t)``.

    References:
        Sun, Ovsjanikov and Guibas 2009; paper, section 2.
    """
    return heat_kernel_values(basis.evals, basis.evecs, times)


def heat_kernel_values(
    evals: Float[Tensor, "*B K"],
    evecs: Float[Tensor, "*B V K"],
    times: Float[Tensor, " n"],
    evals_mask: Bool[Tensor, "*B K"] | None = None,
) -> Float[Tensor, "*B V n"]:
    """:func:`heat_kernel_signature` of a batch, differentiable in all that it is given.

    Args:
        evals: ``(..., K)``.
        evecs: ``(..., V, K)``.
        times: ``(n,)`` diffusion times (1 / unit of ``evals``).
        evals_mask: ``(..., K)`` true where a function is real, not padding.
    """
    scores = -evals[..., :, None] * times
    if evals_mask is not None:
        scores = scores.masked_fill(~evals_mask[..., :, None], -torch.inf)
    return evecs.square() @ torch.softmax(scores, dim=-2).to(evecs.dtype)  # no 0 / 0 where all exp underflow


def split_descriptors(values: Sequence[Values], s: int = 5) -> list[Float[Tensor, "_V sC"]]:
    """Replace each descriptor by ``s`` bumps telling where on the shape it takes which value.

    ``f_i(x) = exp(-(f(x) - a_i)^2 / sigma^2)`` with ``sigma = (b - a) / s`` and ``a_i = a + i sigma``, ``i = 1..s``,
    where ``[a, b]`` is the range of the descriptor over *all* the shapes, so that bump i means the same on each.

    Args:
        values: one ``(V_m, C)`` tensor a shape, the same descriptors in the same order.
        s: number of intervals; 0 returns the input.

    Returns:
        One ``(V_m, s C)`` tensor a shape; bump i of descriptor c stands in column ``c s + i``.

    References:
        Paper, section 4.1, "Increasing the rank".
    """
    if s < 0:
        raise ValueError(f"s={s}: the number of intervals is 0 (no splitting) or more")
    if s == 0:
        return list(values)
    low = torch.stack([v.min(0).values for v in values]).min(0).values
    high = torch.stack([v.max(0).values for v in values]).max(0).values
    sigma = ((high - low) / s).clamp_min(_tiny(low))  # of a constant descriptor: 0
    centres = low[:, None] + sigma[:, None] * torch.arange(1, s + 1, dtype=low.dtype)
    # In place, one array in and one out: this is the largest of the whole method. Differentiable all the same.
    return [(v[:, :, None] - centres).div_(sigma[:, None]).square().neg_().exp_().flatten(1) for v in values]


def unit_columns(coefficients: Sequence[Float[Tensor, "_K C"]]) -> list[Float[Tensor, "_K C"]]:
    """Scale descriptor columns to unit norm, by one factor for all shapes (the root mean square of their norms).

    A common factor keeps ``C f = g`` the equation it was, and lets no descriptor outweigh the others by its units.
    """
    norm = torch.stack([c.square().sum(0) for c in coefficients]).mean(0).sqrt()
    return [c / norm.clamp_min(_tiny(norm)) for c in coefficients]


def _tiny(values: Tensor) -> float:
    """The smallest normal number of a tensor's type: keeps a division by zero from making NaN."""
    return torch.finfo(values.dtype).tiny
