"""Guesses at the symmetries of a shape, as functional maps: from landmarks, and from the parity of eigenfunctions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.refine import nearest_isometry
from torchqm.matching.landmark_maps import LandmarkMaps
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.parity import parity_patterns
from torchqm.matching.quality import displacement, distance_change
from torchqm.matching.self_map import grow_self_map, nearest_involution, reflection_score
from torchqm.matching.shape import PreparedShape
from torchqm.spectral.descriptors import wave_energies, wave_kernel_signature
from torchqm.symmetry.landmarks import find_landmarks, landmark_permutations
from torchqm.symmetry.orientation import orientation_cosine, orientation_tensor

__all__ = ["SAME", "Judge", "Proposal", "correlation", "different", "grown", "propose", "regrown"]

VARIANTS: tuple[tuple[int, tuple[float, ...], tuple[tuple[float, float, float], ...]], ...] = (
    (60, (1.0, 2.0), ((0.1, 1.0, 1.0), (0.1, 0.3, 1.0))),
    (60, (1.0,), ((0.3, 0.3, 3.0),)),
    (40, (1.0,), ((1.0, 1.0, 1.0),)),
)
"""Functions in the Green's functions, their powers, and the weights of :meth:`LandmarkMaps.solve`. No single choice is
best on all shapes; these four together had the best candidates on the harder ones of TOSCA's tuning classes."""

FIRST, SECOND, CHOICE = 40, 60, 100
"""Functions at which all maps, the better ones, and the best ones are compared."""

EXACT = 1e-9  # scores of exact symmetries: which of them is the best is a matter of rounding
CLOSE = 1.25
"""Maps with up to this multiple of the best score are ranked by how they change distances, too."""

FEW = 40
"""Proposals from landmarks below which signs of eigenfunctions are tried, too: an egg has two tips."""

LIKELY, N_LIKELY = 10.0, 8
"""Permutations of landmarks that cost up to this multiple of the cheapest, and how many of them, have their best map
grown to the end however it looks on the way. Where several parts of a shape are nearly symmetric each for itself (arms,
and each leg), their permutations cost about the same, and the right one need not begin well."""

SAME = 0.8
"""Correlation above which two maps are one symmetry."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A functional map that may be a symmetry.

    Args:
        fmap: ``(K, K)`` orthonormal.
        orientation: +1 if it should keep the orientation of the surface, -1 if it should turn it over.
        involution: whether it undoes itself.
        score: what speaks against it (:class:`Judge`); 0 is exact.
        likely: the number of the permutation of landmarks that it came from, if that is one of the cheapest; else -1.
    """

    fmap: Float[Tensor, "K K"]
    orientation: int
    involution: bool
    score: float = float("inf")
    likely: int = -1


def correlation(a: Float[Tensor, "K K"], b: Float[Tensor, "K K"]) -> float:
    """``tr(A^T B) / K`` of two orthonormal maps: 1 if they are the same, near 0 if they differ everywhere.

    Example:
        >>> import torch
        >>> correlation(torch.eye(4), torch.diag(torch.tensor([1.0, 1.0, 1.0, -1.0])))
        0.5
    """
    return float((a * b).sum()) / a.shape[0]


def different(proposals: Sequence[Proposal], n: int, most: float = 0.95) -> list[Proposal]:
    """The first n of which no two correlate by more than ``most``."""
    kept: list[Proposal] = []
    for proposal in proposals:
        if len(kept) < n and all(correlation(proposal.fmap, k.fmap) <= most for k in kept):
            kept.append(proposal)
    return kept


class Judge:
    """What speaks against a self-map: :func:`torchqm.matching.self_map.reflection_score`, and wrong orientation.

    Args:
        x: the shape.
        n_faces: about how many triangles are used (:func:`torchqm.symmetry.orientation.orientation_tensor`).
    """

    def __init__(self, x: PreparedShape, n_faces: int = 8000) -> None:
        self.x = x
        self.omega = orientation_tensor(x.mesh, x.basis, n_faces=n_faces)

    def orientation(self, fmap: Float[Tensor, "K K"]) -> float:
        """Cosine between the images of ``omega(f, g)`` and ``omega(C f, C g)``; 1: a rotation, -1: a reflection."""
        return orientation_cosine(fmap, self.omega, self.omega)

    def score(self, fmap: Float[Tensor, "K K"], orientation: int) -> float:
        """0 for a symmetry; half of what the cosine lacks to 0.5 in the right direction is added."""
        agreement = orientation * self.orientation(fmap) if self.x.oriented else 1.0
        return reflection_score(fmap, self.x) + 0.5 * max(0.0, 0.5 - agreement)


def grown(
    proposal: Proposal, judge: Judge, parameters: MatchParameters, k: int, n_samples: int, n_anchors: int
) -> Proposal:
    """The map at ``k`` functions, with its score there."""
    few = parameters.changed(n_samples=min(n_samples, parameters.n_samples), refinement="upsample")
    fmap = grow_self_map(proposal.fmap, judge.x, few, k, n_anchors, proposal.involution)
    return replace(proposal, fmap=fmap, score=judge.score(fmap, proposal.orientation))


def regrown(proposal: Proposal, judge: Judge, parameters: MatchParameters, start: int = 30, times: int = 4) -> Proposal:
    """The map begun anew from its first functions, as long as that makes it better.

    What was wrong on the way up stays in the low functions of the map; at a hundred functions they are right more often
    than they were at first, and what grows from them is better.
    """
    for _ in range(times):
        project = nearest_involution if proposal.involution else nearest_isometry
        seed = replace(proposal, fmap=project(proposal.fmap[:start, :start]))
        new = grown(seed, judge, parameters, CHOICE, 1000, 3000)
        if new.score >= proposal.score:
            break
        proposal = new
    return proposal


def propose(
    judge: Judge, parameters: MatchParameters, n_permutations: int = 24, n_kept: int = 6, most: int = 20
) -> list[Proposal]:
    """Maps of a shape to itself at a hundred functions, the best first; no two are nearly the same.

    Args:
        judge: of the shape.
        parameters: ``growth``, ``k_max``, ``n_samples`` are used.
        n_permutations: permutations of landmarks that are tried.
        n_kept: different maps that are grown to the end, at least.
        most: different maps that are grown to the end where they are all about as good as the best.
    """
    first = _from_landmarks(judge, n_permutations, min(30, parameters.k_max))
    if len(first) < FEW:
        first += _from_parity(judge, min(8, parameters.k_max - 1))
    rough = sorted((grown(p, judge, parameters, FIRST, 400, 1000) for p in first), key=_by_score)
    second = [grown(p, judge, parameters, SECOND, 600, 1500) for p in different(rough, 2 * most)]
    second.sort(key=_by_score)
    limit = max(2.5 * second[0].score, EXACT) if second else 0.0
    kept = [p for i, p in enumerate(different(second, most, SAME)) if i < n_kept or p.score <= limit]
    kept += _unseen(rough, kept, judge, parameters)
    pool = sorted((grown(p, judge, parameters, CHOICE, 1000, 3000) for p in kept), key=_by_score)
    limit = max(2.0 * pool[0].score, EXACT) if pool else 0.0
    hopeful = [p.score <= limit or i < 3 or p.likely >= 0 for i, p in enumerate(pool)]
    pool = [regrown(p, judge, parameters) if hope else p for p, hope in zip(pool, hopeful, strict=True)]
    return different(_ranked(pool, judge.x), len(pool), SAME)


def _unseen(
    rough: Sequence[Proposal], kept: Sequence[Proposal], judge: Judge, parameters: MatchParameters
) -> list[Proposal]:
    """The best map of each likely permutation that has none among those kept; ``rough`` has the best first."""
    seen, first = {p.likely for p in kept}, dict[int, Proposal]()
    for proposal in rough:
        if proposal.likely >= 0 and proposal.likely not in seen:
            first.setdefault(proposal.likely, proposal)
    more = [grown(p, judge, parameters, SECOND, 600, 1500) for p in first.values()]
    return [p for p in more if all(correlation(p.fmap, k.fmap) <= SAME for k in kept)]


def _ranked(pool: list[Proposal], x: PreparedShape) -> list[Proposal]:
    """By score; those that are close to the best one by score times change of distances over displacement.

    Commutativity alone does not see that a map joins the halves of two symmetries; distances across the shape do. And a
    map that leaves points near where they are changes little, whether it is a symmetry or not: of a person, what turns
    front to back changes distances less than what mirrors left and right, but moves points half as far.
    """
    limit = CLOSE * min((p.score for p in pool), default=0.0)

    def key(proposal: Proposal) -> tuple[bool, float]:
        score = proposal.score * (1.3 if proposal.orientation > 0 else 1.0)
        far = proposal.score > limit
        return far, score if far else score * distance_change(proposal.fmap, x, x) / max(
            displacement(proposal.fmap, x.basis.evals), 1e-3
        )

    return sorted(pool, key=key)


def _by_score(proposal: Proposal) -> float:
    return proposal.score


def _from_landmarks(judge: Judge, n: int, k: int) -> list[Proposal]:
    x = judge.x
    landmarks = find_landmarks(x.mesh, x.basis)
    values = _descriptors(x)
    found = []
    permutations = landmark_permutations(landmarks, n)
    limit = LIKELY * min((p.cost for p in permutations), default=0.0)
    likely = [i for i, p in enumerate(permutations) if p.cost <= limit][:N_LIKELY]
    for n_smooth, powers, weights in VARIANTS:
        maps = LandmarkMaps(x, landmarks, values, k, n_smooth, powers)
        for i, permutation in enumerate(permutations):
            number = i if i in likely else -1
            for chosen in weights:
                fmap = maps.solve(permutation, *chosen)
                found.append(Proposal(fmap, permutation.orientation, permutation.involutive, likely=number))
    return found


def _from_parity(judge: Judge, n_functions: int, n: int = 48) -> list[Proposal]:
    basis = judge.x.basis
    n_functions = min(n_functions, basis.k - 1)
    small = basis.truncate(n_functions + 1)
    values = _descriptors(judge.x)
    patterns = parity_patterns(small, small.coefficients(values), n_functions, n)
    return [Proposal(fmap, sign, True) for fmap in patterns.fmaps for sign in (-1, 1)]


def _descriptors(x: PreparedShape) -> Float[Tensor, "V C"]:
    basis = x.basis.truncate(min(100, x.basis.k))
    return wave_kernel_signature(basis, wave_energies([basis], 20))
