"""Quotient matching where the symmetric functions are estimated from a symmetry-factored embedding.

The quotient paper asks for it (section 8: "it would be interesting to see if this space can be estimated automatically
e.g. using the method of [LCDF10]"). No symmetry is found: only which functions are symmetric.

References:
    Lipman, Chen, Daubechies, Funkhouser. Symmetry factored embedding and distance. SIGGRAPH 2010 (LCDF10): the points
    of an orbit are a clique of a correspondence graph, whose spectral embedding sends them to one place. There an edge
    says how well a symmetry that joins the two points maps the shape to itself; here it compares their intrinsic
    descriptors, which every isometry keeps.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.refine import quotient_icp
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result, shared_size
from torchqm.matching.initial import basis_size, curvature_descriptors, initial_fmap, shared_descriptors
from torchqm.matching.odd import join_blocks, solve_odd
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.quotient import dense_map, refine_fmap
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.descriptors import wave_energies, wave_kernel_signature
from torchqm.symmetry.basis import EvenOddBasis, split_by_projector

__all__ = ["SymmetryFactored", "correspondence_graph", "even_projector", "symmetry_factored_embedding"]


def correspondence_graph(features: Float[Tensor, "S C"], neighbours: int = 5, rounds: int = 30) -> Float[Tensor, "S S"]:
    """Symmetric doubly stochastic matrix of ``exp(-d_ij^2 / (h_i h_j))``, d the distance between descriptors.

    ``h_i`` is the distance to the ``neighbours``-th most similar point. As an operator it averages a function over
    points that look alike: over orbits, up to a small blur.

    Args:
        features: descriptors of points drawn by area.
        neighbours: sets the width.
        rounds: of the alternating scaling to row sums 1.

    Raises:
        ValueError: not more points than neighbours.

    Example:
        >>> pairs = torch.tensor([[0.0], [0.0], [1.0], [1.0], [2.0], [2.0]])
        >>> correspondence_graph(pairs, neighbours=1)[0].round(decimals=2).tolist()
        [0.5, 0.5, 0.0, 0.0, 0.0, 0.0]
    """
    if not 1 <= neighbours < len(features):
        raise ValueError(f"neighbours={neighbours}: allowed are 1 to {len(features) - 1} for {len(features)} points")
    distance = torch.cdist(features, features)
    width = distance.kthvalue(neighbours + 1, dim=1).values.clamp_min(1e-12 * float(distance.max()) + 1e-300)
    graph = torch.exp(-(distance.square() / (width[:, None] * width[None])))
    for _ in range(rounds):
        scale = graph.sum(1).rsqrt()
        graph = scale[:, None] * graph * scale[None]
    return graph


def symmetry_factored_embedding(graph: Float[Tensor, "S S"], time: float = 0.5) -> Float[Tensor, "S M"]:
    """``(lambda_m^t psi_m)`` of a correspondence graph's positive eigenpairs: points of one orbit come to one place.

    Args:
        graph: symmetric (:func:`correspondence_graph`).
        time: t; at 1/2 the products of two points' coordinates are the entries of the graph itself.
    """
    values, vectors = torch.linalg.eigh(graph)
    kept = values > 1e-3
    return (vectors[:, kept] * values[kept] ** time).flip(1)


def even_projector(
    basis: SpectralBasis, samples: Int[Tensor, " S"], embedding: Float[Tensor, "S M"]
) -> Float[Tensor, "K K"]:
    """``Phi^+ E E^T Phi``: averaging over approximate orbits, written in a truncated basis.

    Near 1 on symmetric functions that are smooth on the scale of the graph, near 0 on all that change their sign within
    an orbit.

    Args:
        basis: K functions.
        samples: vertex ids of the embedded points, drawn by area.
        embedding: of these points, at ``time = 1/2``.
    """
    at = basis.evecs[samples]
    found = torch.linalg.lstsq(at, embedding @ (embedding.T @ at)).solution
    return (found + found.T) / 2


@dataclass(frozen=True)
class SymmetryFactored:
    """``symmetry-factored``: L2+ of both shapes from symmetry-factored embeddings, then a quotient functional map.

    What follows is what ``quotient`` begins with and ends with: least squares and quotient-ICP on the even functions,
    the odd ones from orientation, spectral upsampling. The complement of L2+ is taken for the odd functions of one
    reflection.

    Args:
        n_embedded: points in the correspondence graph.
        neighbours: its width.
        n_descriptors: energies of the wave kernel signature that is compared.
        parameters: of the quotient map.
        name: in tables.
        needs: see :class:`torchqm.matching.baselines.Matcher`.
    """

    n_embedded: int = 1500
    neighbours: int = 5
    n_descriptors: int = 100
    parameters: MatchParameters = field(default_factory=MatchParameters)
    name: str = "symmetry-factored"
    needs: tuple[str, ...] = ()

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """Two maps, direct and mirrored, or one; see :class:`torchqm.matching.baselines.Matcher`.

        Raises:
            MatchError: too few eigenfunctions or points.
        """
        given.check(x, y)
        steps, parameters = Steps(), self.parameters
        k = basis_size([x.basis, y.basis], shared_size(x, y, parameters.k))
        with steps("symmetry-factored embedding"):
            source, target = (self.split(shape, k) for shape in (x, y))
        with steps("quotient matching"):
            values_x, values_y = shared_descriptors([x.basis, y.basis], parameters)
            more = curvature_descriptors(x, y) if parameters.local_weight > 0 else None
            even = initial_fmap(source.even, target.even, values_x, values_y, parameters.commutativity, more)
            samples, among = x.samples[: parameters.n_samples], target.even.restricted(y.anchors)
            even = quotient_icp(
                even, source.even, among, samples, parameters.icp_steps, tolerance=parameters.icp_tolerance
            )
        notes = [f"{source.even.k} and {target.even.k} of the first {k} functions were taken for symmetric"]
        labels: tuple[str, ...] = ("direct", "mirrored")
        with steps("odd functions"):
            if min(source.odd.k, target.odd.k) < 1 or not (x.oriented and y.oriented):
                fmaps, labels = [self._whole(source, target, even)], ("unknown",)
                notes.append("the odd functions could not be matched: the one map is a mixture")
            else:
                odd = solve_odd(x.mesh, y.mesh, source.even, target.even, even, source.odd, target.odd)
                fmaps = [join_blocks(source, target, even, sign * odd.fmap) for sign in (1.0, -1.0)]
                labels = labels if odd.separated else ("unknown", "unknown")
        with steps("refinement and point maps"):
            maps = [dense_map(refine_fmap(fmap, x, y, parameters), x, y) for fmap in fmaps]
        return make_result(self.name, x, y, torch.stack(maps), steps, labels, notes, k=k)

    def split(self, shape: PreparedShape, k: int) -> EvenOddBasis:
        """The first k functions of a shape, split by its own symmetry-factored embedding.

        Raises:
            MatchError: fewer points than the graph needs.
        """
        ids = shape.samples[: self.n_embedded]
        if len(ids) <= max(k, self.neighbours):
            raise MatchError(f"n_embedded={len(ids)}: more than {max(k, self.neighbours)} points are needed")
        # Not all that the shape has: the result must not depend on what else it was prepared for.
        sharp = shape.basis.truncate(min(self.parameters.k_max, shape.basis.k))
        signature = wave_kernel_signature(sharp, wave_energies([sharp], self.n_descriptors))[ids]
        features = (signature - signature.mean(0)) / signature.std(0).clamp_min(torch.finfo(signature.dtype).tiny)
        embedding = symmetry_factored_embedding(correspondence_graph(features, self.neighbours))
        basis = shape.basis.truncate(k)
        return split_by_projector(basis, even_projector(basis, ids, embedding))

    @staticmethod
    def _whole(source: EvenOddBasis, target: EvenOddBasis, even: Tensor) -> Tensor:
        """The even block in the full bases."""
        return target.even_coeffs @ even @ source.even_coeffs.T
