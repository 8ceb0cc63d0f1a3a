"""Semi-quotient matching: the symmetry is known on the target only (paper, section 5)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p
from torchqm.fmap.refine import growing_sizes, nearest_isometry, semi_quotient_icp, semi_upsample
from torchqm.fmap.surface_search import SurfaceSearch
from torchqm.fmap.threads import in_parallel
from torchqm.matching.described import pair_descriptors
from torchqm.matching.initial import basis_size, fmap_from_coefficients
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.basis import EvenOddBasis, split_by_projector, symmetrized_basis
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["SemiQuotientMatch", "match_semi_quotient", "pull_back", "sharpen_orbit_map"]


@dataclass(frozen=True, eq=False)
class SemiQuotientMatch:
    """A map from all functions on the source to the symmetric functions on the target.

    Args:
        fmap: ``(K+_y, k)`` with orthonormal rows: ``R = pi+ o T``.
        target: the target's basis split by its known symmetry.
        source: the source's basis split by what the map says: L2+ of the source is the complement of the kernel of R.
        even: ``(K+_y, K+_x)``, R restricted to that L2+: a square isometry.
        time: diffusion time of the deltas.
        search: how dense maps onto the target are searched for.
        guide: the same of the source.
    """

    fmap: Float[Tensor, "Key Kx"]
    target: EvenOddBasis
    source: EvenOddBasis
    even: Float[Tensor, "Key Kex"]
    time: float = 0.0
    search: SurfaceSearch | None = None
    guide: SurfaceSearch | None = None

    @cached_property
    def orbit_map(self) -> Int[Tensor, " Vx"]:
        """For each source vertex a target vertex whose *orbit* is the image (paper, sections 4.4 and 5).

        Which point of the orbit stands here is arbitrary and may differ between neighbours.
        """
        return fmap_to_p2p(self.fmap, self.source.full, self.target.even, self.time, self.search, self.guide)


def match_semi_quotient(
    x: PreparedShape,
    y: PreparedShape,
    group_y: SymmetryGroup,
    parameters: MatchParameters,
    values: tuple[Float[Tensor, "Vx C"], Float[Tensor, "Vy C"]] | None = None,
) -> SemiQuotientMatch:
    """Match a shape without known symmetry to one whose symmetry group is given.

    Descriptors and commutativity give the initial ``k/2 x k`` matrix in least squares; semi-quotient ICP refines it.

    Args:
        x: source; nothing is known of its symmetry.
        y: target.
        group_y: symmetry group of the target.
        parameters: ``k``, descriptors, ``icp_steps``, ``semi_width``, ``time`` are used.
        values: descriptors of both in the place of wave or heat kernel signatures.

    References:
        Paper, section 5 and Lemma 5.1.
    """
    k = basis_size([x.basis, y.basis], parameters.k)
    basis_x = x.basis.truncate(k)
    split = partial(symmetrized_basis, y.basis.truncate(k), group_y)
    if values is None:
        beside: list[Callable[[], Any]] = [partial(pair_descriptors, x, y, parameters), split]
        described, target = in_parallel(beside)
        columns_x, columns_y = (c[:k] for c in described.coefficients)
    else:
        target = split()
        columns_x, columns_y = basis_x.coefficients(values[0]), target.full.coefficients(values[1])
    columns = columns_x, target.even_coeffs.T @ columns_y
    fmap = fmap_from_coefficients(columns, basis_x.evals, target.even.evals, parameters.commutativity)
    samples = x.samples[: parameters.n_samples]
    among = target.even.restricted(y.anchors)
    fmap = semi_quotient_icp(
        fmap,
        basis_x,
        among,
        samples,
        parameters.icp_steps,
        parameters.time,
        parameters.semi_width,
        parameters.icp_tolerance,
    )
    fmap = nearest_isometry(fmap)
    source = split_by_projector(basis_x, fmap.T @ fmap)
    return SemiQuotientMatch(fmap, target, source, fmap @ source.even_coeffs, parameters.time, y.search, x.search)


def sharpen_orbit_map(
    semi: SemiQuotientMatch,
    x: PreparedShape,
    y: PreparedShape,
    group_y: SymmetryGroup,
    parameters: MatchParameters,
    k: int = 100,
) -> Int[Tensor, " Vx"]:
    """A point-to-orbit map from more functions: the semi-quotient map upsampled to ``k`` of the source.

    Args:
        semi: the match at ``parameters.k``.
        x: source.
        y: target.
        group_y: symmetry of the target.
        parameters: ``growth``, ``n_samples`` and ``semi_width`` are used.
        k: functions of the source to reach.

    Returns:
        ``(Vx,)``, as ``semi.orbit_map``.
    """
    k = min(k, x.basis.k)
    even_y = symmetrized_basis(y.basis.truncate(min(k + k // 5, y.basis.k)), group_y).even
    sizes = growing_sizes(semi.fmap.shape[1], k, parameters.growth)
    fmap = semi_upsample(
        semi.fmap,
        x.basis,
        even_y.restricted(y.anchors),
        x.samples[: parameters.n_samples],
        [*sizes, k],
        parameters.semi_width,
    )
    small_x, small_y = x.basis.truncate(fmap.shape[1]), even_y.truncate(fmap.shape[0])
    return fmap_to_p2p(fmap, small_x, small_y, search=y.search, guide=x.search)


def pull_back(values: Float[Tensor, "Vy C"], orbit_map: Int[Tensor, " Vx"]) -> Float[Tensor, "Vx C"]:
    """Bring symmetric functions of the target to the source: ``f(x) = g(R(x))`` (paper, section 5, function transfer).

    The pseudo-inverse of R would do it in the span of k functions only; through the point-to-orbit map nothing is lost.
    The functions must be symmetric, else the arbitrary choice within an orbit shows.
    """
    return values[orbit_map]
