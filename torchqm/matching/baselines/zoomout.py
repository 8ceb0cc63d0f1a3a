"""ZoomOut: from a functional map to a point map and back to a larger functional map, again and again.

References:
    Melzi, Ren, Rodola, Sharma, Wonka, Ovsjanikov. ZoomOut: Spectral upsampling for efficient shape correspondence.
    SIGGRAPH Asia 2019, section 4, equations 1 and 2; the fast variant is its acceleration by farthest-point samples.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p, nearest_used
from torchqm.fmap.nearest import nearest_rows
from torchqm.fmap.surface_search import SurfaceSearch
from torchqm.geometry.sampling import farthest_points
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result
from torchqm.matching.baselines.functional import Start
from torchqm.matching.parameters import MatchError
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps
from torchqm.spectral.basis import SpectralBasis

__all__ = ["ZoomOut", "zoomout", "zoomout_on_samples", "zoomout_sizes"]


def zoomout_sizes(start: int, stop: int, step: int) -> list[int]:
    """Basis sizes ``start + step, start + 2 step, ...`` up to and including ``stop``.

    Example:
        >>> zoomout_sizes(20, 33, 5)
        [25, 30, 33]
    """
    if step < 1:
        raise ValueError(f"step={step}: the basis must grow by at least 1")
    sizes = list(range(start + step, stop, step))
    return [*sizes, stop] if stop > start else []


def zoomout(
    p2p_xy: Int[Tensor, " Vx"],
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    sizes: list[int],
    search: SurfaceSearch | None = None,
    guide: SurfaceSearch | None = None,
) -> Int[Tensor, " Vx"]:
    """ZoomOut on all vertices.

    At each size k: ``C = Phi_x^T A_x Phi_y[T]`` (functions on y to functions on x), then
    ``T(p) = argmin_q || C phi_y(q) - phi_x(p) ||``. There is no orthogonal projection.

    Args:
        p2p_xy: the first point map.
        basis_x: of the source, with at least ``max(sizes)`` functions.
        basis_y: of the target.
        sizes: numbers of functions.
        search: on y, as in :func:`torchqm.fmap.convert.fmap_to_p2p`: ten times faster on large meshes; by default all
            vertices are compared.
        guide: that of x.

    Returns:
        The point map at the last size.

    Raises:
        ValueError: a size that the bases do not hold.
    """
    _check_sizes(sizes, basis_x, basis_y)
    for k in sizes:
        small_x, small_y = basis_x.truncate(k), basis_y.truncate(k)
        fmap_yx = small_x.coefficients(small_y.evecs[p2p_xy])
        p2p_xy = _nearest(fmap_yx, small_x, small_y, search, guide)
    return p2p_xy


def zoomout_on_samples(
    p2p_xy: Int[Tensor, " Sx"],
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    samples_x: Int[Tensor, " Sx"],
    samples_y: Int[Tensor, " Sy"],
    sizes: list[int],
) -> Float[Tensor, "K K"]:
    """ZoomOut that only looks at some of the vertices; ``C`` is least squares on the samples instead of an integral.

    Args:
        p2p_xy: for each sample of x the number (not the vertex id) of a sample of y.
        basis_x: of the source.
        basis_y: of the target.
        samples_x: vertex ids, spread over the surface, more than ``max(sizes)``.
        samples_y: likewise.
        sizes: numbers of functions, at least one.

    Returns:
        ``fmap_yx`` at the last size, functions on y to functions on x.

    Raises:
        ValueError: a size that the bases do not hold, or that is above the number of samples.
    """
    _check_sizes(sizes, basis_x, basis_y)
    if not sizes or max(sizes) > len(samples_x):
        raise ValueError(f"sizes: {sizes[-1:]} functions cannot be told apart on {len(samples_x)} samples")
    at_x, at_y = basis_x.evecs[samples_x], basis_y.evecs[samples_y]
    fmap = at_x.new_zeros(0, 0)
    for number, k in enumerate(sizes):
        if number:
            p2p_xy = nearest_rows(at_x[:, : fmap.shape[0]], at_y[:, : fmap.shape[0]] @ fmap.T)
        fmap = torch.linalg.lstsq(at_x[:, :k], at_y[p2p_xy, :k]).solution
    return fmap


def _nearest(
    fmap_yx: Tensor,
    small_x: SpectralBasis,
    small_y: SpectralBasis,
    search: SurfaceSearch | None = None,
    guide: SurfaceSearch | None = None,
) -> Tensor:
    """``argmin_q || C phi_y(q) - phi_x(p) ||`` over the vertices q of y that a face uses."""
    images = small_y.evecs @ fmap_yx.T
    if search is not None:
        return search.nearest(small_x.evecs, images, guide)
    return nearest_used(small_x.evecs, SpectralBasis(small_x.evals, images, small_y.mass))


def _check_sizes(sizes: list[int], basis_x: SpectralBasis, basis_y: SpectralBasis) -> None:
    if sizes and max(sizes) > min(basis_x.k, basis_y.k):
        raise ValueError(f"sizes: up to {max(sizes)}, but the bases have {basis_x.k} and {basis_y.k} functions")


@dataclass(frozen=True)
class ZoomOut:
    """``zoomout`` and, with samples, ``zoomout-fast``: from the functional map that ``fmap`` starts with, too.

    Args:
        start: the first map.
        k_max: eigenfunctions at the end, at most.
        step: functions by which the basis grows.
        n_samples: farthest points on each shape; None looks at all vertices.
        exact: compare each vertex with all others, instead of the two-stage search that all methods here use on meshes
            of 10,000 vertices or more; the errors are the same, the time is ten times as long.
        name: in tables.
        needs: see :class:`torchqm.matching.baselines.Matcher`.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.matching import prepare
        >>> x, y = (prepare(creature("ellipsoid", 500, pose=pose).mesh, k=40) for pose in (0, 1))
        >>> ZoomOut(Start(k=20)).match(x, y).details["k"]
        40
    """

    start: Start = field(default_factory=Start)
    k_max: int = 200
    step: int = 5
    n_samples: int | None = None
    exact: bool = False
    name: str = "zoomout"
    needs: tuple[str, ...] = ()

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """One map; see :class:`torchqm.matching.baselines.Matcher`."""
        given.check(x, y)
        steps = Steps()
        fmap = self.start.solve(x, y, given, steps)
        k = fmap.shape[0]
        k_max = min(self.k_max, x.basis.k, y.basis.k)
        if k_max <= k:
            raise MatchError(f"k_max={k_max}: must be above the {k} functions of the start; take a smaller one")
        sizes = zoomout_sizes(k, k_max, self.step)
        p2p = self._all(fmap, x, y, sizes, steps) if self.n_samples is None else self._few(fmap, x, y, sizes, steps)
        notes = [f"basis from {k} to {k_max} functions by {self.step}"]
        return make_result(self.name, x, y, p2p, steps, notes=notes, k=k_max)

    def _all(self, fmap: Tensor, x: PreparedShape, y: PreparedShape, sizes: list[int], steps: Steps) -> Tensor:
        k = fmap.shape[0]
        with steps("ZoomOut"):
            search, guide = (None, None) if self.exact else (y.search, x.search)
            p2p = fmap_to_p2p(fmap, x.basis.truncate(k), y.basis.truncate(k), search=search, guide=guide)
            return zoomout(p2p, x.basis, y.basis, sizes, search, guide)

    def _few(self, fmap: Tensor, x: PreparedShape, y: PreparedShape, sizes: list[int], steps: Steps) -> Tensor:
        k, n = fmap.shape[0], self.n_samples
        assert n is not None
        if n < sizes[-1]:
            raise MatchError(f"n_samples={n}: at least as many as the {sizes[-1]} functions are needed")
        with steps("farthest points"):
            samples_x, samples_y = (
                farthest_points(s.mesh, min(n, int(s.mesh.referenced.sum())), method="euclidean") for s in (x, y)
            )
        with steps("ZoomOut"):
            p2p = nearest_rows(x.basis.evecs[samples_x, :k] @ fmap.T, y.basis.evecs[samples_y, :k])
            fmap_yx = zoomout_on_samples(p2p, x.basis, y.basis, samples_x, samples_y, sizes)
        with steps("point map"):
            small_x, small_y = x.basis.truncate(sizes[-1]), y.basis.truncate(sizes[-1])
            search, guide = (None, None) if self.exact else (y.search, x.search)
            return _nearest(fmap_yx, small_x, small_y, search, guide)
