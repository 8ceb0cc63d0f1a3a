"""The symmetries of a single shape from its own spectrum: no reference, no mirror plane, no landmarks from outside."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p
from torchqm.fmap.threads import one_thread
from torchqm.matching.assemble import ALIKE, FunctionalGroup, assemble
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.parity import odd_halves
from torchqm.matching.proposals import Judge, Proposal, correlation, propose
from torchqm.matching.quality import commutativity_score, map_label, orientation_agreement
from torchqm.matching.quotient import pair_places
from torchqm.matching.self_map import grow_self_map, settled_self_map
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.algebra import group_name
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["Detection", "detect_group"]

SYMMETRIC, ASYMMETRIC = (0.15, 0.13), (0.17, 0.145)
"""Score of the best candidate, and commutativity of its vertex map, up to which it is a symmetry; and above which it is
none. Right maps had up to 0.151 and 0.116 on TOSCA's cat, centaur, david and wolf and on the creatures in 20 poses; the
best maps of the creature without symmetry 0.179 and 0.135 at least."""

LARGEST_IRREDUCIBLE = 5
"""Dimension of the largest irreducible representation of a finite group of rotations and reflections, that of the
icosahedron. Larger eigenspaces come from an infinite group."""


@dataclass(frozen=True, eq=False)
class Detection:
    """The symmetries of a shape that were found, and how far to trust them.

    Args:
        group: as vertex maps; the trivial group if the verdict is ``asymmetric``.
        fmaps: ``(E, K, K)`` the functional maps of its elements, E = G; if the verdict is ``asymmetric`` those of the
            identity and of the best candidate.
        orientation: ``(E,)`` +1 where an element keeps the orientation of the surface, -1 where it turns it over.
        scores: ``(E,)`` of each element, 0 is exact (:class:`torchqm.matching.proposals.Judge`).
        sign: ``(V,)`` left and right of a group of one reflection: -1, +1, 0 where undecided; else all 0.
        products: ``(G, G)`` which element is nearest to g after h.
        name: of the group, such as ``C2`` or ``D8`` (order 16).
        verdict: ``symmetric``, ``ambiguous`` or ``asymmetric``.
        parts: the numbers behind it, of maps before local features settled them
            (:func:`torchqm.matching.self_map.settled_self_map`). ``score`` (of the best candidate at 100 functions),
            ``runner_up`` (of the best candidate that is no element of the group), ``margin`` (their ratio), ``refused``
            (how many good maps did not fit into the group). Of the best vertex map:
            ``commutativity`` (150 functions; with ``score`` it decides by :data:`SYMMETRIC` and :data:`ASYMMETRIC`),
            ``embedding`` (relative distance between the image of a delta and the delta that it is taken for),
            ``involution`` (mean distance between x and S(S(x)) / sqrt(area)), ``moved`` (share of the area that goes
            further than 0.02 sqrt(area)), ``orientation`` (-1 where S turns over every triangle).
        candidates: how many different maps were compared.
        warnings: what is doubtful, with the numbers.
    """

    group: SymmetryGroup
    fmaps: Float[Tensor, "E K K"]
    orientation: Float[Tensor, " E"]
    scores: Float[Tensor, " E"]
    sign: Float[Tensor, " V"]
    products: Int[Tensor, "G G"]
    name: str
    verdict: str
    parts: dict[str, float]
    candidates: int
    warnings: list[str] = field(default_factory=list)


def detect_group(x: PreparedShape, parameters: MatchParameters | None = None) -> Detection:
    """Find the intrinsic symmetries of a shape.

    The tips of the shape are landmarks; the permutations of them that change distances and oriented volumes least each
    give a functional map (:class:`torchqm.matching.landmark_maps.LandmarkMaps`), which is grown by spectral upsampling
    and, where the permutation undoes itself, projected to an involution at each step. Signs of the first eigenfunctions
    give further maps where there are few tips. The best ones make a group
    (:func:`torchqm.matching.assemble.assemble`), whose elements are refined up to ``k_max`` functions.

    Args:
        x: the shape.
        parameters: ``k_max``, ``n_samples``, ``growth`` are used.

    Returns:
        The group found, with a verdict. Nothing is made up: of a shape without symmetry the best map has a large score,
        the verdict is ``asymmetric``, and the group is trivial.

    References:
        Paper, section 8: that the symmetry must be known, and be one reflection, is lifted here.
    """
    parameters = (parameters or MatchParameters()).changed(refinement="upsample")
    with one_thread():
        judge = Judge(x)
        pool = propose(judge, parameters)
        found = assemble(pool, judge, parameters)
    return _judged(judge, pool, found, parameters)


def _judged(judge: Judge, pool: Sequence[Proposal], found: FunctionalGroup, parameters: MatchParameters) -> Detection:
    """Refine the elements, make them vertex maps and measure the best one."""
    x, elements = judge.x, found.elements[1:] or pool[:1]
    best = elements[0]
    with one_thread():
        fmap = grow_self_map(best.fmap, x, parameters, parameters.k_max, involution=best.involution)
    p2p = _point_map(fmap, x)
    parts = _parts(x, fmap, p2p)
    parts["score"] = best.score
    rest = [p.score for p in pool if all(correlation(p.fmap, e.fmap) <= ALIKE for e in elements)]
    parts["runner_up"] = min(rest, default=float("inf"))
    parts["margin"] = parts["runner_up"] / max(parts["score"], 1e-300)
    parts["refused"] = float(found.tried)
    parts["orientation"] = orientation_agreement(x.mesh, x.mesh, p2p) if x.oriented else 0.0
    # Small triangles are turned over by the errors of a right map; smooth functions are not.
    label = map_label(parts["orientation"], judge.orientation(fmap)) if x.oriented else ""
    turned = not x.oriented or label == ("direct" if best.orientation > 0 else "mirrored")
    numbers, name = _text(parts), x.mesh.label
    verdict, warnings = "symmetric", []
    faults = [
        text
        for fault, text in (
            (parts["score"] > ASYMMETRIC[0] or parts["commutativity"] > ASYMMETRIC[1], "is far from an isometry"),
            (found.order == 1, "makes no group, its powers are no good maps"),
            (parts["moved"] < 0.5, "leaves half of the shape where it is"),
            (not turned, "keeps the orientation here and turns it over there"),
        )
        if fault
    ]
    if faults:
        verdict = "asymmetric"
        warnings.append(f"{name}: no symmetry was found: the best map {' and '.join(faults)} ({numbers})")
    elif parts["score"] > SYMMETRIC[0] or parts["commutativity"] > SYMMETRIC[1] or parts["moved"] < 0.7:
        verdict = "ambiguous"
        warnings.append(f"{name}: the symmetry found may be wrong in parts ({numbers})")
    equal = _largest_cluster(x.basis.evals)
    if verdict != "asymmetric" and equal > LARGEST_IRREDUCIBLE:
        verdict = "ambiguous"
        warnings.append(
            f"{name}: {equal} eigenvalues are equal to 1%, and no finite symmetry explains more than "
            f"{LARGEST_IRREDUCIBLE}: the shape has infinitely many symmetries, as a sphere has; these are some of them"
        )
    sign = torch.zeros_like(x.basis.mass)
    if verdict == "asymmetric":
        group, products = SymmetryGroup.trivial(x.n_verts), torch.zeros(1, 1, dtype=torch.int64)
        elements, fmaps = elements[:1], [fmap]
    else:
        # The numbers above are those of a map that knows nothing of local features, which would flatter it.
        places, _ = pair_places(x, x, parameters)
        if len(elements) > 1:  # they were averaged over all products already, and there are many of them
            places = places.fewer(1000, 3000)
        with one_thread():
            starts = [fmap, *(element.fmap for element in elements[1:])]
            fmaps = [
                settled_self_map(start, x, parameters, places, element.involution)
                for start, element in zip(starts, elements, strict=True)
            ]
        group = SymmetryGroup(torch.stack([torch.arange(x.n_verts), *(_point_map(f, x) for f in fmaps)]))
        products = found.products
        if group.order == 2 and best.orientation < 0:
            sign = odd_halves(x.mesh, x.basis, fmaps[0])
    orientation = torch.tensor([1.0, *(float(e.orientation) for e in elements)], dtype=torch.float64)
    scores = torch.tensor([0.0, *(e.score for e in elements)], dtype=torch.float64)
    identity = torch.eye(len(fmaps[0]), dtype=fmaps[0].dtype)
    return Detection(
        group,
        torch.stack([identity, *fmaps]),
        orientation,
        scores,
        sign,
        products,
        group_name(products),
        verdict,
        parts,
        len(pool),
        warnings,
    )


def _point_map(fmap: Tensor, x: PreparedShape) -> Tensor:
    basis = x.basis.truncate(fmap.shape[0])
    return fmap_to_p2p(fmap, basis, basis, search=x.search, guide=x.search)


def _largest_cluster(evals: Tensor, k: int = 30, rtol: float = 0.01) -> int:
    """How many of the first eigenvalues after 0 are equal, each to its neighbour."""
    first = evals[1:k]
    longest, length = 1, 1
    for same in (first.diff() < rtol * first[1:]).tolist():
        length = length + 1 if same else 1
        longest = max(longest, length)
    return longest


def _parts(x: PreparedShape, fmap: Tensor, p2p: Tensor) -> dict[str, float]:
    """What can be said of one vertex map without any truth."""
    basis = x.basis.truncate(fmap.shape[0])
    images = basis.evecs @ fmap.T
    verts, mass = x.mesh.verts, x.mesh.vertex_areas
    missed = ((images - basis.evecs[p2p]).square().sum(1) * mass).sum()
    return {
        "commutativity": commutativity_score(p2p, x.basis, x.basis, 150),
        "embedding": float(missed / (images.square().sum(1) * mass).sum()),
        "involution": float(((verts - verts[p2p[p2p]]).norm(dim=1) * mass).sum()),
        "moved": float(mass[(verts - verts[p2p]).norm(dim=1) > 0.02].sum()),
    }


def _text(parts: dict[str, Any]) -> str:
    return (
        f"score {parts['score']:.2f} and commutativity {parts['commutativity']:.3f}, where 0 is exact, "
        f"{SYMMETRIC[0]:g} and {SYMMETRIC[1]:g} the limits of a symmetry, {ASYMMETRIC[0]:g} and {ASYMMETRIC[1]:g} of a "
        f"doubtful one; {parts['moved']:.0%} of the area moves; orientation {parts['orientation']:+.2f}, where "
        "-1 is a reflection and 1 a rotation"
    )
