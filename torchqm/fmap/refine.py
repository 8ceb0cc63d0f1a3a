"""Refinement of functional maps: quotient-ICP, semi-quotient ICP, spectral upsampling (paper, sections 4.3, 5, 7.4)."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import deltas, nearest_used
from torchqm.fmap.polar import nearest_isometry
from torchqm.spectral.basis import SpectralBasis

__all__ = [
    "correspondence_fmap",
    "frequency_mask",
    "growing_sizes",
    "quotient_icp",
    "semi_quotient_icp",
    "semi_upsample",
    "upsample",
]

FMap = Float[Tensor, "Ky Kx"]


def frequency_mask(evals_x: Float[Tensor, " Kx"], evals_y: Float[Tensor, " Ky"], width: float = 0.2) -> FMap:
    """``exp(-(|mu_i - lambda_j| / max / width)^2)``: damps entries of C that join far frequencies.

    Semi-quotient ICP as printed in the paper drifts, even from the true map: nothing in its projection step asks for
    commutativity. Multiplying the correspondence matrix by this mask before the SVD keeps it.
    """
    scale = torch.maximum(evals_x.max(), evals_y.max()).clamp_min(1e-300)
    return torch.exp(-(((evals_y[:, None] - evals_x[None, :]) / scale / width) ** 2))


def quotient_icp(
    fmap_xy: FMap,
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    samples: Int[Tensor, " S"],
    steps: int = 20,
    time: float = 0.0,
    width: float | None = None,
    tolerance: float = 0.0,
) -> FMap:
    """Iterate: nearest deltas of the samples, then the isometry nearest to their correspondence matrix.

    ``T_i(x) = argmin_y || delta_+^{y,t} - C_i delta_+^{x,t} ||`` for x in the sample, and ``C_{i+1}`` is
    ``sum_x delta_+^{T_i(x),t} (delta_+^{x,t})^T`` with its singular values replaced by one. Stops before ``steps`` when
    the map no longer changes. (The partners themselves may go on changing: the points of an orbit have equal deltas.)

    Args:
        fmap_xy: initial map, functions on x to functions on y.
        basis_x: basis of L2+ of the source (Kx functions).
        basis_y: basis of L2+ of the target (Ky functions); restricted to some vertices
            (:meth:`torchqm.spectral.SpectralBasis.restricted`), only these are searched.
        samples: vertex ids of x, drawn by area so that their sum approximates an integral.
        steps: number of iterations.
        time: diffusion time t of the deltas (area).
        width: if given, :func:`frequency_mask` of that width multiplies the matrix before the SVD.
        tolerance: relative change of the map (Frobenius norm) below which the iteration stops; rounding always counts.

    Returns:
        The refined map.

    References:
        Paper, section 4.3, Quotient-ICP.
    """
    if steps < 0:
        raise ValueError(f"steps={steps}: the number of iterations must not be negative")
    if fmap_xy.shape != (basis_y.k, basis_x.k):
        raise ValueError(f"fmap_xy: expected shape ({basis_y.k}, {basis_x.k}), got {tuple(fmap_xy.shape)}")
    sources = deltas(basis_x, time)[samples]
    targets = deltas(basis_y, time)
    mask = None if width is None else frequency_mask(basis_x.evals, basis_y.evals, width)
    settled = max(tolerance, torch.finfo(fmap_xy.dtype).eps ** 0.5)
    for _ in range(steps):
        partners = nearest_used(sources @ fmap_xy.T, basis_y, time, exact=False)
        correspondence = targets[partners].T @ sources
        last, fmap_xy = fmap_xy, nearest_isometry(correspondence if mask is None else correspondence * mask)
        if float((fmap_xy - last).norm()) < settled * float(fmap_xy.norm()):
            break
    return fmap_xy


def semi_quotient_icp(
    fmap_xy: FMap,
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    samples: Int[Tensor, " S"],
    steps: int = 20,
    time: float = 0.0,
    width: float | None = 0.2,
    tolerance: float = 0.0,
) -> FMap:
    """ICP from the full function space of x to the symmetric functions of y.

    The same iteration as :func:`quotient_icp`, on a matrix of about ``k/2 x k``: setting its singular values to one
    first takes the complement of the kernel as L2+ of x and then makes the map an isometry there.

    Args:
        fmap_xy: ``(Ky, Kx)`` with ``Ky <= Kx``.
        basis_x: *full* basis of x.
        basis_y: basis of L2+ of y.
        samples: vertex ids of x, drawn by area.
        steps: number of iterations.
        time: diffusion time of the deltas.
        width: see :func:`frequency_mask`; ``None`` gives the iteration exactly as printed.
        tolerance: as in :func:`quotient_icp`.

    References:
        Paper, section 5, Semi-quotient ICP, and Lemma 5.1.
    """
    if basis_y.k > basis_x.k:
        raise ValueError(
            f"the target has {basis_y.k} symmetric functions, the source only {basis_x.k} functions at all: "
            "a semi-quotient map goes onto the smaller space"
        )
    return quotient_icp(fmap_xy, basis_x, basis_y, samples, steps, time, width, tolerance)


def growing_sizes(start: int, stop: int, ratio: float = 1.2) -> list[int]:
    """Basis sizes that grow by a constant ratio from ``start``, up to and including ``stop``; empty if already there.

    Growing by a fifth measured as good as by ten functions at a time, in half the time: what a map at k functions can
    tell about the next ones depends on their wavelength, not on their number.

    Example:
        >>> growing_sizes(30, 60, 1.5)
        [45, 60]
    """
    if ratio <= 1 or start < 1:
        raise ValueError(f"ratio={ratio}, start={start}: the ratio must be above 1 and the start at least 1")
    sizes, size = [], start
    while size < stop:
        size = min(stop, max(size + 1, round(size * ratio)))
        sizes.append(size)
    return sizes


def upsample(
    fmap_xy: FMap,
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    samples: Int[Tensor, " S"],
    sizes: Sequence[int],
    steps: int = 1,
    project: Callable[[Tensor], Tensor] = nearest_isometry,
) -> Float[Tensor, "Ly Lx"]:
    """Spectral upsampling with orthogonal projection: match the samples at one size, read the map off at the next.

    At size m (of both bases): ``C_m = polar(sum_x delta_{T(x)} delta_x^T)`` in the first m functions, where T comes
    from the map before. With ``steps > 1`` each size gets that many iterations (the paper's ICP at k = 100 and 300).

    Args:
        fmap_xy: initial map between the first functions of the two bases.
        basis_x: basis of x with at least ``max(sizes)`` functions.
        basis_y: basis of y, likewise.
        samples: vertex ids of x, drawn by area.
        sizes: numbers of functions, one after the other.
        steps: iterations at each size.
        project: what is made of the correspondence matrix at each step.

    Returns:
        The map at the last size.

    References:
        Paper, section 7.4 (k = 100 and 300); Melzi et al. 2019 for the growing basis.
    """
    if steps < 1:
        raise ValueError(f"steps={steps}: each size needs at least one iteration")
    if len(sizes) and max(sizes) > min(basis_x.k, basis_y.k):
        raise ValueError(f"sizes up to {max(sizes)}: the bases have {basis_x.k} and {basis_y.k} functions")
    at_x = basis_x.evecs[samples]
    for size in sizes:
        small_y = basis_y.truncate(size)
        for _ in range(steps):
            ky, kx = fmap_xy.shape
            partners = nearest_used(at_x[:, :kx] @ fmap_xy.T, basis_y.truncate(ky), exact=False)
            fmap_xy = project(small_y.evecs[partners].T @ at_x[:, :size])
    return fmap_xy


def semi_upsample(
    fmap_xy: FMap,
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    samples: Int[Tensor, " S"],
    sizes: Sequence[int],
    width: float | None = 0.2,
) -> Float[Tensor, "Ly Lx"]:
    """Spectral upsampling of a semi-quotient map: k functions of x to the symmetric functions of y as low as those.

    At 30 functions a point-to-orbit map is too blurred for the displacement that it pulls back to be low all along the
    axis, and clustering then cuts off a limb instead of a half. At 100 it is sharp enough.

    Args:
        fmap_xy: ``(Ky, Kx)`` map onto the first Ky symmetric functions of y.
        basis_x: full basis of x.
        basis_y: basis of L2+ of y, large enough to hold every function below the highest of ``basis_x`` in use.
        samples: vertex ids of x, drawn by area.
        sizes: numbers of functions of x.
        width: of the :func:`frequency_mask`.

    References:
        Paper, sections 5 and 7.4.
    """
    for size in sizes:
        small_x = basis_x.truncate(size)
        # Rounding must not decide whether the symmetric function that is the highest of x itself still counts.
        matching = int((basis_y.evals <= small_x.evals[-1] * (1 + 1e-6)).sum())
        small_y = basis_y.truncate(min(max(matching, 1), size))
        ky, kx = fmap_xy.shape
        partners = nearest_used(basis_x.evecs[samples, :kx] @ fmap_xy.T, basis_y.truncate(ky), exact=False)
        matrix = small_y.evecs[partners].T @ small_x.evecs[samples]
        mask = 1.0 if width is None else frequency_mask(small_x.evals, small_y.evals, width)
        fmap_xy = nearest_isometry(matrix * mask)
    return fmap_xy


def correspondence_fmap(
    p2p_xy: Int[Tensor, " Vx"], basis_x: SpectralBasis, basis_y: SpectralBasis, samples: Int[Tensor, " S"]
) -> FMap:
    """The isometry nearest to the correspondence matrix ``sum_x delta_{T(x)} delta_x^T`` of a point map's samples."""
    return nearest_isometry(basis_y.evecs[p2p_xy[samples]].T @ basis_x.evecs[samples])
