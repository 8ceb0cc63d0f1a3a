"""The reflection of a single shape from its own spectrum: no reference, no mirror plane, no landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p
from torchqm.matching.initial import shared_descriptors
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.parity import odd_halves, parity_patterns
from torchqm.matching.quality import commutativity_score, orientation_agreement
from torchqm.matching.self_map import grow_self_map, reflection_score, self_maps_from_halves
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.group import SymmetryGroup
from torchqm.symmetry.orientation import function_pairs, orientation_coefficients

__all__ = ["Detection", "detect_reflection"]

SYMMETRIC, ASYMMETRIC = (0.15, 0.12), (0.22, 0.145)
"""Score of the best candidate, and commutativity of its vertex map, up to which it is a symmetry; and above which it is
none. Right maps had up to 0.12 and 0.12 on TOSCA's cat, centaur, david and wolf and on the creatures; the best maps of
a creature without symmetry 0.16 to 0.46 and 0.15 to 0.25."""

GOOD = 0.05
"""Score at which no further pattern is tried: that of a firm symmetry."""

FIRST, CHOICE = 40, 100


@dataclass(frozen=True, eq=False)
class Detection:
    """The best reflection of a shape that was found, and how far to trust it.

    Args:
        group: ``{id, S}`` as vertex maps; the trivial group if the verdict is ``asymmetric``.
        reflection: ``(V,)`` the vertex map S, whatever the verdict.
        fmap: ``(K, K)`` its functional map.
        sign: ``(V,)`` left and right: -1, +1, 0 where undecided.
        verdict: ``symmetric``, ``ambiguous`` or ``asymmetric``.
        parts: the numbers behind it. ``score`` (of the best candidate at 100 functions), ``runner_up`` (of the
            best candidate that is another map) and ``margin`` (their ratio). Of the vertex map: ``commutativity`` (150
            functions; with ``score`` it decides by :data:`SYMMETRIC` and :data:`ASYMMETRIC`), ``embedding`` (relative
            distance between the image of a delta and the delta that it is taken for), ``involution`` (mean distance
            between x and S(S(x)) / sqrt(area)), ``moved`` (share of the area that changes sides), ``orientation`` (-1
            where S turns over every triangle).
        candidates: how many maps were compared.
        warnings: what is doubtful, with the numbers.
    """

    group: SymmetryGroup
    reflection: Tensor
    fmap: Float[Tensor, "K K"]
    sign: Float[Tensor, " V"]
    verdict: str
    parts: dict[str, float]
    candidates: int
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Candidate:
    fmap: Tensor
    score: float


def detect_reflection(
    x: PreparedShape, parameters: MatchParameters | None = None, n_patterns: int = 64, n_kept: int = 6
) -> Detection:
    """Find the intrinsic reflection of a shape.

    Patterns of even and odd on the first eigenfunctions (:func:`torchqm.matching.parity.parity_patterns`) are grown by
    spectral upsampling, projected to involutions at each step. Of the few best and most different ones each is turned
    into left and right halves (:func:`torchqm.matching.parity.odd_halves`) and these into a new map (paper, section
    6.1, symmetry reconstruction): a map that mirrors the arms and leaves the legs gives the right halves all the same,
    and comes back whole. What has the least :func:`torchqm.matching.self_map.reflection_score`, and turns the surface
    over, is refined up to ``k_max`` functions.

    Args:
        x: the shape.
        parameters: ``k``, ``k_max``, descriptors, ``n_samples``, ``growth`` are used.
        n_patterns: patterns that are grown.
        n_kept: how many of them are turned into halves.

    Returns:
        The best map found, with a verdict. Nothing is made up: of a shape without symmetry the best map has a large
        score, the verdict is ``asymmetric``, and the group is trivial.

    References:
        Paper, section 8 (the symmetry must be known: lifted here) and section 6.1.
    """
    parameters = parameters or MatchParameters()
    (values,) = shared_descriptors([x.basis], parameters)
    n_functions = min(8, x.basis.k - 1)
    basis = x.basis.truncate(min(x.basis.k, max(parameters.k, n_functions + 1)))
    patterns = parity_patterns(basis, basis.coefficients(values), n_functions, n_patterns)
    few = parameters.changed(n_samples=500, refinement="upsample")
    many = parameters.changed(refinement="upsample")
    rough = [grow_self_map(fmap, x, few, FIRST, n_anchors=1500) for fmap in patterns.fmaps]
    rough.sort(key=lambda fmap: reflection_score(fmap, x))
    orientation = _OrientationAgreement(x) if x.oriented else None

    def judged(fmap: Tensor) -> _Candidate:
        against = 0.0 if orientation is None else 0.5 * max(0.0, 0.5 + orientation(fmap))
        return _Candidate(fmap, reflection_score(fmap, x) + against)

    pool: list[_Candidate] = []

    def add_from_halves(fmap: Tensor) -> None:
        sign = odd_halves(x.mesh, x.basis, fmap)
        found = self_maps_from_halves(x, sign, many, values)
        pool.extend(judged(grow_self_map(new, x, many, CHOICE)) for new in found)

    first = sorted((judged(fmap) for fmap in rough[: 4 * n_kept]), key=_by_score)
    for candidate in _different(first, n_kept):
        grown = grow_self_map(candidate.fmap, x, many, CHOICE)
        pool.append(judged(grown))
        add_from_halves(grown)
        if min(pool, key=_by_score).score < GOOD:
            break
    for _ in range(2):
        best = min(pool, key=_by_score)
        add_from_halves(best.fmap)
        if min(pool, key=_by_score).score > best.score - 1e-3:
            break
    return _judge(x, sorted(pool, key=_by_score), many)


def _by_score(candidate: _Candidate) -> float:
    return candidate.score


def _different(candidates: Sequence[_Candidate], n: int, least: float = 0.3) -> list[_Candidate]:
    """The first n that differ from all before them by a relative Frobenius distance."""
    kept: list[_Candidate] = []
    for candidate in candidates:
        size = float(candidate.fmap.norm())
        if len(kept) < n and all(float((candidate.fmap - k.fmap).norm()) > least * size for k in kept):
            kept.append(candidate)
    return kept


class _OrientationAgreement:
    """``omega`` of pairs of low functions, computed once, to be compared with that of their images under self-maps.

    On every n-th triangle only: what is compared is smooth, and only its sign and rough size matter.
    """

    def __init__(self, x: PreparedShape, n_functions: int = 8, k: int = 60, n_faces: int = 8000) -> None:
        self.x, self.k = x, min(k, x.basis.k)
        self.mesh = replace(x.mesh, faces=x.mesh.faces[:: max(1, x.mesh.n_faces // n_faces)])
        self.n = min(n_functions, self.k)
        self.pairs = function_pairs(self.n)
        self.own = self._omega(x.basis.evecs[:, : self.n])

    def _omega(self, values: Tensor) -> Tensor:
        return orientation_coefficients(self.mesh, values, self.pairs, self.x.basis.evecs[:, : self.k])

    def __call__(self, fmap: Tensor) -> float:
        """Cosine between the images of ``omega(f, g)`` and ``omega(C f, C g)``; 1: a rotation, -1: a reflection."""
        k = min(self.k, fmap.shape[0])
        images = self._omega(self.x.basis.evecs[:, : fmap.shape[0]] @ fmap[:, : self.n])[:k]
        wanted = fmap[:k, :k] @ self.own[:k]
        return float((wanted * images).sum() / (wanted.norm() * images.norm()).clamp_min(1e-300))


def _judge(x: PreparedShape, pool: list[_Candidate], parameters: MatchParameters) -> Detection:
    """Refine the best candidate, make it a vertex map and measure that."""
    best = pool[0]
    others = _different(pool, 2)
    fmap = grow_self_map(best.fmap, x, parameters, parameters.k_max)
    basis = x.basis.truncate(fmap.shape[0])
    reflection = fmap_to_p2p(fmap, basis, basis, search=x.search, guide=x.search)
    sign = odd_halves(x.mesh, x.basis, fmap)
    images = basis.evecs @ fmap.T
    verts, mass = x.mesh.verts, x.mesh.vertex_areas
    parts: dict[str, float] = {
        "commutativity": commutativity_score(reflection, x.basis, x.basis, 150),
        "embedding": float(
            ((images - basis.evecs[reflection]).square().sum(1) * mass).sum() / (images.square().sum(1) * mass).sum()
        ),
        "involution": float(((verts - verts[reflection[reflection]]).norm(dim=1) * mass).sum()),
        "moved": float(((sign * sign[reflection] < 0) * mass).sum()),
        "orientation": orientation_agreement(x.mesh, x.mesh, reflection) if x.oriented else 0.0,
        "score": best.score,
        "runner_up": others[1].score if len(others) > 1 else float("inf"),
    }
    parts["margin"] = parts["runner_up"] / max(best.score, 1e-300)
    name, numbers = x.mesh.label, _text(parts)
    verdict, warnings = "symmetric", []
    turned = not x.oriented or parts["orientation"] < -0.3
    if best.score > ASYMMETRIC[0] or parts["commutativity"] > ASYMMETRIC[1] or parts["moved"] < 0.5 or not turned:
        verdict = "asymmetric"
        warnings.append(f"{name}: no reflection was found: the best map is far from an isometry ({numbers})")
    elif best.score > SYMMETRIC[0] or parts["commutativity"] > SYMMETRIC[1] or parts["moved"] < 0.7:
        verdict = "ambiguous"
        warnings.append(f"{name}: the reflection found may be wrong in parts ({numbers})")
    if verdict == "asymmetric":
        group, sign = SymmetryGroup.trivial(x.n_verts), torch.zeros_like(sign)
    else:
        group = SymmetryGroup.from_reflection(reflection)
    return Detection(group, reflection, fmap, sign, verdict, parts, len(pool), warnings)


def _text(parts: dict[str, Any]) -> str:
    return (
        f"score {parts['score']:.2f} and commutativity {parts['commutativity']:.3f}, where 0 is exact, "
        f"{SYMMETRIC[0]:g} and {SYMMETRIC[1]:g} the limits of a symmetry, {ASYMMETRIC[0]:g} and {ASYMMETRIC[1]:g} of a "
        f"doubtful one; {parts['moved']:.0%} of the area changes sides; orientation {parts['orientation']:+.2f}, where "
        "-1 is a reflection"
    )
