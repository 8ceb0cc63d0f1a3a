"""From two prepared shapes and their symmetries to the dense maps between them, with labels and scores."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchqm.fmap.convert import p2p_to_fmap
from torchqm.fmap.refine import correspondence_fmap
from torchqm.fmap.threads import in_parallel
from torchqm.matching.candidates import full_map_from_blocks
from torchqm.matching.initial import basis_size
from torchqm.matching.known import KnownSymmetry, no_symmetry
from torchqm.matching.orbits import full_map_from_orbits, quotient_size
from torchqm.matching.outside import Descriptors, describe_pair
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.quality import commutativity_score, map_label, orientation_agreement
from torchqm.matching.quotient import (
    choose_halves,
    dense_map,
    match_quotient,
    refine_by_icp,
    refine_fmap,
)
from torchqm.matching.result import MatchResult
from torchqm.matching.semi_quotient import match_semi_quotient
from torchqm.matching.shape import PreparedShape, complete
from torchqm.matching.steps import Steps
from torchqm.matching.subgroups import common_symmetry, one_reflection
from torchqm.symmetry.orientation import orientation_cosine, orientation_tensor

__all__ = ["COST", "DETECTION", "POOR_SCORE", "match_prepared"]

POOR_SCORE = 0.15
"""Commutativity score above which a map is called poor; true maps of TOSCA have 0.03 (wolf) to 0.13 (cat)."""

COST = {"eigenpairs": 0.05, "plane": 0.02, "detect": 0.1, "transfer": 0.04, "quotient": 0.005, "maps": 0.03}
"""Expected seconds per step and 1000 vertices, for the share of work done; only their ratios matter."""

DETECTION = 2.5
"""Expected seconds of a detection that do not depend on the number of vertices."""


def match_prepared(
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    method: str = "quotient",
    parameters: MatchParameters | None = None,
    steps: Steps | None = None,
    descriptors: Descriptors | None = None,
) -> MatchResult:
    """Match two prepared shapes with known symmetries; see :func:`match`."""
    parameters = parameters or MatchParameters()
    steps = steps or Steps()
    earlier = dict(steps.seconds)
    warnings = list(dict.fromkeys([*x.warnings, *y.warnings, *known_x.warnings, *known_y.warnings]))
    known_x, known_y, remark = _in_common(x, y, known_x, known_y, method)
    warnings += [remark] if remark else []
    k = basis_size([x.basis, y.basis], parameters.k)
    if k < parameters.k:
        warnings.append(f"k is {k} instead of {parameters.k}: the next eigenvalues equal the one before them")
    warnings += [text for shape in (x, y) if (text := _spectrum_warning(shape, k))]
    details: dict[str, Any] = {
        "source": {"name": x.mesh.label, "vertices": x.n_verts, "laplacian": x.operator, "symmetry": known_x.origin}
        | known_x.details,
        "target": {"name": y.mesh.label, "vertices": y.n_verts, "laplacian": y.operator, "symmetry": known_y.origin}
        | known_y.details,
    }
    if not known_x.known:
        warnings.append("no symmetry is used: of several equally good maps one comes back, possibly a mixture of them")
    work = x.n_verts / 1000
    curved = parameters.local_weight > 0
    oriented = x.oriented and y.oriented
    separated, values = None, None
    if descriptors is not None:
        with steps("descriptors"):
            values = describe_pair(x, y, descriptors)
        details |= {"descriptors": repr(descriptors), "n_descriptors": values[0].shape[1]}
    if method == "semi":
        with steps("semi-quotient matching", COST["quotient"] * work):
            complete((x, y), False)
            semi = match_semi_quotient(x, y, known_y.group, parameters, values)
            even, p2p, fmap = semi.even, semi.orbit_map, None
            if known_y.known:
                p2p = choose_halves(p2p, known_y.group, known_x.sign, known_y.sign)
    else:
        with steps("quotient matching", COST["quotient"] * work):
            complete((x, y), curved)
            one = known_x.group.order == 1 or (known_x.reflection and known_y.reflection)
            k_used = None if one else quotient_size(known_x.group.order, parameters)
            found = match_quotient(x, y, known_x.group, known_y.group, parameters, k_used, values)
        even = found.fmap
        with steps("point maps and refinement", COST["maps"] * work):
            if not known_x.known:
                fmap = refine_fmap(found.fmap, x, y, parameters)
            elif not one:
                orbits = full_map_from_orbits(found, x, y, known_x, known_y, parameters)
                details |= {"orbit_residual": orbits.residual}
                fmap = refine_fmap(orbits.fmap, x, y, parameters)
            elif method == "quotient" and oriented:
                full = full_map_from_blocks(found, x, y, known_x, known_y, parameters)
                fmap, odd, even = full.fmap, full.odd, full.quotient.fmap
                if not full.synchronized:
                    details |= {"residual_direct": odd.residual_direct, "residual_mirrored": odd.residual_mirrored}
                details |= {"candidate_scores": list(full.scores)}
                details |= {"synchronized": full.synchronized}
                separated = None if full.synchronized else odd.separated
            else:
                halves = choose_halves(found.orbit_map(x, y), known_y.group, known_x.sign, known_y.sign)
                if parameters.refinement == "icp":
                    fmap = refine_by_icp(halves, x, y, parameters)
                else:
                    samples = x.samples[: parameters.n_samples]
                    fmap = correspondence_fmap(halves, found.source.full, found.target.full, samples)
                    fmap = refine_fmap(fmap, x, y, parameters)
            p2p = dense_map(fmap, x, y)
    with steps("scores and labels"):
        if fmap is None:
            fmap = correspondence_fmap(p2p, x.basis.truncate(k), y.basis.truncate(k), x.samples)
        maps = known_y.group.maps[:, p2p]
        basis_y = y.basis.truncate(fmap.shape[0])
        n = len(maps)
        # Row 0 is the identity; what takes longest comes first.
        found_fmaps, numbers, omegas = _together(
            [partial(p2p_to_fmap, m, basis_y, basis_y) for m in known_y.group.maps[1:]],
            [partial(orientation_agreement, x.mesh, y.mesh, m) for m in maps]
            + [partial(commutativity_score, m, x.basis, y.basis) for m in maps],
            [partial(orientation_tensor, shape.mesh, shape.basis) for shape in (x, y) if oriented],
        )
        agreement, scores = numbers[:n], torch.tensor(numbers[n:], dtype=torch.float64)
        fmaps = torch.stack([fmap, *(c @ fmap for c in found_fmaps)])
        label = "unknown"
        if oriented:
            omega_x, omega_y = omegas
            cosines = [orientation_cosine(c, omega_x, omega_y) for c in fmaps]
            details |= {"orientation_cosines": cosines}
            # The elements of the group say how the maps are oriented to each other; so one label gives them all.
            turned = known_y.orientation
            label = map_label(
                float((turned @ torch.tensor(agreement, dtype=turned.dtype)) / len(maps)),
                float((turned @ torch.tensor(cosines, dtype=turned.dtype)) / len(maps)),
            )
        if not oriented:
            warnings.append("a mesh is not consistently orientable: direct and mirrored cannot be told apart")
        elif separated is False or label == "unknown":
            label = "unknown"
            residuals = {n: round(v, 2) for n, v in details.items() if n.startswith("residual")}
            warnings.append(
                f"direct and mirrored are not told apart: orientation agreement {[round(a, 2) for a in agreement]}"
                + (f", residuals {residuals}" if residuals else "")
            )
        other = {"direct": "mirrored", "mirrored": "direct", "unknown": "unknown"}[label]
        labels = [label if orientation > 0 else other for orientation in known_y.orientation.tolist()]
        if float(scores.min()) > POOR_SCORE:
            warnings.append(
                f"no map is near an isometry (best score {float(scores.min()):.2f}, 0 is exact, {POOR_SCORE} is poor): "
                "the shapes differ too much, or their symmetries do not belong together"
            )
    rank = ("direct", "unknown", "mirrored")
    order = sorted(range(len(labels)), key=lambda g: (rank.index(labels[g]), float(scores[g])))
    return MatchResult(
        maps=maps[order],
        labels=tuple(labels[g] for g in order),
        scores=scores[order],
        orbits=maps[order].T.contiguous(),
        fmaps=fmaps[order],
        fmap_even=even,
        symmetry_source=known_x.group.maps,
        symmetry_target=known_y.group.maps,
        orientation=torch.tensor(agreement, dtype=torch.float64)[order],
        method=method,
        warnings=warnings,
        parameters=parameters.as_dict(),
        seconds=steps.since(earlier),
        details=details,
    )


def _together(
    first: Sequence[Callable[[], Tensor]], second: Sequence[Callable[[], float]], third: Sequence[Callable[[], Tensor]]
) -> tuple[list[Tensor], list[float], list[Tensor]]:
    """The results of three lists of tasks, all of which may run at the same time."""
    found: list[Any] = in_parallel([*first, *second, *third])
    a, b = len(first), len(first) + len(second)
    return found[:a], found[a:b], found[b:]


def _in_common(
    x: PreparedShape, y: PreparedShape, known_x: KnownSymmetry, known_y: KnownSymmetry, method: str
) -> tuple[KnownSymmetry, KnownSymmetry, str | None]:
    """The symmetries that a method can use of two shapes, and what to say of it if these are not all."""
    order_x, order_y = known_x.group.order, known_y.group.order
    names = f"{known_x.name} and {known_y.name}"
    if min(order_x, order_y) == 1:
        if order_x != order_y:
            known_x, known_y = no_symmetry(x), no_symmetry(y)
    elif method == "quotient":
        known_x, known_y = common_symmetry(x, y, known_x, known_y)
    else:
        known_x, known_y = one_reflection(x, y, known_x, known_y)
    order = known_x.group.order
    if order_x != order_y:
        used = "the identity alone" if order == 1 else f"the {order} elements that both have ({known_x.name})"
        return known_x, known_y, f"the groups differ ({order_x} and {order_y} elements): matched with {used}"
    if order != order_x:
        why = "" if method == "quotient" else f": method {method!r} is made for one reflection"
        return known_x, known_y, f"of the symmetries ({names}, {order_x} elements) {order} elements are used{why}"
    return known_x, known_y, None


def _spectrum_warning(shape: PreparedShape, k: int, rtol: float = 1e-3, most: float = 0.2) -> str | None:
    """What to say of a spectrum with many equal eigenvalues: a rotation mixes the functions that share one."""
    evals = shape.basis.evals[1:k]
    equal = int((evals.diff() < rtol * evals[1:]).sum())
    if equal <= most * k:
        return None
    return (
        f"{shape.mesh.label}: ambiguous spectrum: {equal} of the first {k} eigenvalues equal their neighbour to "
        f"{rtol:g}; the shape has more symmetry than one reflection, and which functions belong together is arbitrary"
    )
