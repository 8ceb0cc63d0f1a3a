"""Functional maps as first published: descriptors, commutativity, segments where they are given, and ICP.

No symmetry is used: nothing in intrinsic descriptors tells left from right, so the map comes back plain, mirrored, or
as a mixture of the two, unless segments say more.

References:
    Ovsjanikov, Ben-Chen, Solomon, Butscher, Guibas. Functional maps: a flexible representation of maps between shapes.
    SIGGRAPH 2012 (OBCS12): section 6 for the least squares and the ICP, section 8.1 for ICP in larger bases.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.refine import quotient_icp, upsample
from torchqm.fmap.solve import solve_fmap
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result, shared_size
from torchqm.matching.initial import basis_size, shared_descriptors, unit_columns_pair
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.quotient import dense_map
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.descriptors import wave_energies

__all__ = ["FunctionalMaps", "Start", "segment_functions"]


@dataclass(frozen=True)
class Start:
    """The functional map that :class:`FunctionalMaps` and ZoomOut begin with: least squares, then ICP.

    Chosen on six pairs of TOSCA's tuning classes (cat, centaur, david, wolf) for the least error with flips forgiven:
    of 20, 30 and 50 functions 20; of weights 10, 100 and 1000 100; and ICP before ZoomOut (.040 against .055 without).

    Args:
        k: eigenfunctions of each shape.
        commutativity: weight of commutativity per (descriptor / basis function), eigenvalues scaled to [0, 1].
        icp_steps: of ICP, at most; 0 leaves the least squares as they are.
        n_descriptors: energies of the wave kernel signature.
        splits: intervals into which each descriptor is split (Ovsjanikov et al. 2013, section 4.1); 0 is OBCS12 as
            published, and worse on most pairs.
        n_segment_energies: functions that each segment gives.
        segment_weight: of the segments' functions together, where the descriptors together have 1.
        n_samples: vertices, drawn by area, that ICP uses.
    """

    k: int = 20
    commutativity: float = 100.0
    icp_steps: int = 20
    n_descriptors: int = 100
    splits: int = 5
    n_segment_energies: int = 20
    segment_weight: float = 1.0
    n_samples: int = 2000

    def solve(self, x: PreparedShape, y: PreparedShape, given: Given, steps: Steps) -> Float[Tensor, "Ky Kx"]:
        """The map of functions on x to functions on y.

        Args:
            x: source.
            y: target.
            given: ``segments_x`` and ``segments_y`` are used.
            steps: times ``descriptors``, ``least squares`` and ``ICP``.

        Raises:
            MatchError: too few eigenfunctions.
        """
        k = basis_size([x.basis, y.basis], shared_size(x, y, self.k))
        small_x, small_y = x.basis.truncate(k), y.basis.truncate(k)
        with steps("descriptors"):
            parameters = MatchParameters(
                k_max=max(k, 200), n_descriptors=self.n_descriptors, splits=self.splits, k=max(k, 4)
            )
            values_x, values_y = shared_descriptors([x.basis, y.basis], parameters)
            f, g = unit_columns_pair(small_x.coefficients(values_x), small_y.coefficients(values_y))
            n_columns = f.shape[1]
            if given.common_segments():
                f_parts, g_parts = segment_functions(small_x, small_y, given, self.n_segment_energies)
                scale = (self.segment_weight * n_columns / f_parts.shape[1]) ** 0.5
                f, g = torch.cat([f, scale * f_parts], 1), torch.cat([g, scale * g_parts], 1)
        with steps("least squares"):
            weight = self.commutativity * n_columns / k
            fmap = solve_fmap(f, g, small_x.evals, small_y.evals, weight, ridge=1e-9)
        with steps("ICP"):
            among = small_y.restricted(y.anchors)
            return quotient_icp(fmap, small_x, among, x.samples[: self.n_samples], self.icp_steps)


def segment_functions(
    basis_x: SpectralBasis, basis_y: SpectralBasis, given: Given, n_energies: int = 20
) -> tuple[Float[Tensor, "Kx C"], Float[Tensor, "Ky C"]]:
    """What each pair of corresponding segments says: its indicator function, and that seen through band-passes.

    The indicator ``1_S`` has coefficients ``a``; the function at energy e has ``g(e - log lambda_k) a_k``, ``g`` a
    Gaussian, as in the wave kernel signature (OBCS12 call it the wave kernel map of the segment).

    Args:
        basis_x: of the source.
        basis_y: of the target.
        given: the segments of both.
        n_energies: band-passes; each segment gives one function more than that.

    Returns:
        Coefficients, each column of norm about 1.

    Raises:
        MatchError: there are no segments.
    """
    if given.segments_x is None or given.segments_y is None:
        raise MatchError("segments: none are given")
    energies = wave_energies([basis_x, basis_y], max(n_energies, 2))
    columns: list[list[Tensor]] = [[], []]
    for number in given.common_segments():
        sides = ((basis_x, given.segments_x), (basis_y, given.segments_y))
        for side, (basis, segments) in zip(columns, sides, strict=True):
            indicator = basis.coefficients((segments == number).to(basis.evecs.dtype)[:, None])
            logs = basis.evals[1:].clamp_min(torch.finfo(basis.evals.dtype).tiny).log()
            pass_ = torch.exp(-((energies.log_energies[None] - logs[:, None]) ** 2) / (2 * energies.sigma**2))
            banded = torch.cat([torch.zeros_like(pass_[:1]), pass_]) * indicator
            side.append(torch.cat([indicator, banded], 1))
    return unit_columns_pair(torch.cat(columns[0], 1), torch.cat(columns[1], 1))


@dataclass(frozen=True)
class FunctionalMaps:
    """``fmap``: the functional map of :class:`Start`, then a few steps of ICP in a larger basis, then nearest deltas.

    Args:
        start: the first map.
        k_final: eigenfunctions in the last ICP (OBCS12, section 8.1); at most ``start.k``: no such stage.
        final_steps: its steps.
        name: in tables.
        needs: see :class:`torchqm.matching.baselines.Matcher`.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.matching import prepare
        >>> x, y = (prepare(creature("ellipsoid", 500, pose=pose).mesh, k=40) for pose in (0, 1))
        >>> FunctionalMaps(Start(k=20)).match(x, y).maps.shape[0]
        1
    """

    start: Start = Start()
    k_final: int = 100
    final_steps: int = 5
    name: str = "fmap"
    needs: tuple[str, ...] = ()

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """One map; see :class:`torchqm.matching.baselines.Matcher`."""
        given.check(x, y)
        steps = Steps()
        fmap = self.start.solve(x, y, given, steps)
        k_final = min(self.k_final, x.basis.k, y.basis.k)
        if k_final > fmap.shape[0] and self.final_steps:
            with steps("ICP in a larger basis"):
                among, samples = y.basis.restricted(y.anchors), x.samples[: self.start.n_samples]
                fmap = upsample(fmap, x.basis, among, samples, [k_final], self.final_steps)
        with steps("point map"):
            p2p = dense_map(fmap, x, y)
        n_segments = len(given.common_segments())
        notes = [f"{n_segments} corresponding segments were used" if n_segments else "no segments were given"]
        return make_result(self.name, x, y, p2p, steps, notes=notes, k=fmap.shape[0])
