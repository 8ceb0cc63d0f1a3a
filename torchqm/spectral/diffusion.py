"""Heat flow in a truncated eigenbasis: smoothing of each channel for its own time."""

from jaxtyping import Float
from torch import Tensor

__all__ = ["spectral_diffusion"]


def spectral_diffusion(
    values: Float[Tensor, "*B V C"],
    mass: Float[Tensor, "*B V"],
    evals: Float[Tensor, "*B K"],
    evecs: Float[Tensor, "*B V K"],
    times: Float[Tensor, " C"],
) -> Float[Tensor, "*B V C"]:
    """``u_c = sum_k exp(-lambda_k t_c) <phi_k, f_c> phi_k`` with ``<f, g> = sum_i mass_i f_i g_i``.

    What lies outside the basis is lost, also at time zero. Neither signs of the functions nor rotations inside a
    cluster of equal eigenvalues matter. Differentiable in all arguments; padding by zeros (of mass, evals and evecs)
    changes nothing and gives zero.

    Args:
        values: ``(..., V, C)`` functions f.
        mass: ``(..., V)`` vertex areas.
        evals: ``(..., K)`` eigenvalues, in 1 / unit of ``times``.
        evecs: ``(..., V, K)`` eigenfunctions, orthonormal in the mass.
        times: ``(C,)`` for each channel.

    Returns:
        ``(..., V, C)``.

    Example:
        >>> import torch
        >>> mass, evecs = torch.full((2,), 0.5), torch.tensor([[1.0, 1.0], [1.0, -1.0]])
        >>> times = torch.tensor([0.0, 100.0])
        >>> spectral_diffusion(torch.tensor([[3.0, 3.0], [1.0, 1.0]]), mass, torch.tensor([0.0, 2.0]), evecs, times)
        tensor([[3., 2.],
                [1., 2.]])

    References:
        N. Sharp, S. Attaiki, K. Crane, M. Ovsjanikov, "DiffusionNet: Discretization Agnostic Learning on Surfaces",
        2022, section 3.2, "Spectral Acceleration".
    """
    coefficients = evecs.transpose(-1, -2) @ (mass[..., None] * values)
    return evecs @ ((-evals[..., None] * times).exp() * coefficients)
