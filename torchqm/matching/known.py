"""Where a shape's symmetry comes from: its mirror plane, the user, or a reference shape."""

from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.convert import p2p_to_fmap
from torchqm.matching.detect import detect_reflection
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.parity import odd_halves
from torchqm.matching.self_map import nearest_involution
from torchqm.matching.shape import PreparedShape
from torchqm.matching.symmetry_file import reflection_fault, return_error
from torchqm.matching.transfer import transfer_symmetry
from torchqm.symmetry.basis import symmetrized_basis
from torchqm.symmetry.extrinsic import ExtrinsicReflection, find_reflections
from torchqm.symmetry.group import SymmetryGroup
from torchqm.symmetry.leftright import halves_of_reflection

__all__ = [
    "KnownSymmetry",
    "best_fitting",
    "detected_symmetry",
    "extrinsic_symmetry",
    "given_symmetry",
    "no_symmetry",
    "transferred_symmetry",
]


N_COMPARED = 30
"""Functions whose symmetric part is compared to tell reflections of a shape apart."""


@dataclass(frozen=True, eq=False)
class KnownSymmetry:
    """A symmetry group with the left-right map that goes with its reflection.

    Args:
        group: the group; trivial if the shape has no symmetry that is known.
        sign: ``(V,)`` -1 on one half, +1 on the other, 0 on the axis; all 0 for the trivial group.
        origin: ``extrinsic``, ``detected``, ``file``, ``transfer`` or ``none``.
        warnings: what is doubtful, with the numbers.
        details: numbers for the summary.
        others: further reflections that the shape has just as well, each alone; see :func:`best_fitting`.
    """

    group: SymmetryGroup
    sign: Float[Tensor, " V"]
    origin: str
    warnings: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    others: tuple["KnownSymmetry", ...] = ()

    @property
    def known(self) -> bool:
        """Whether there is more than the identity."""
        return self.group.order > 1

    @property
    def firm(self) -> bool:
        """Whether it is known without a doubt: a better source for a transfer than a doubtful symmetry of one's own."""
        return self.known and not self.warnings

    def remarks(self, name: str) -> list[str]:
        """The warnings, and what to say of further reflections of the shape of that name."""
        more = f"{name}: {len(self.others)} more mirror plane(s) fit as well; only one reflection is used"
        return [*self.warnings, more] if self.others else self.warnings


def no_symmetry(shape: PreparedShape, warnings: list[str] | None = None) -> KnownSymmetry:
    """The trivial group: the shape goes through the same code and gives one map."""
    group = SymmetryGroup.trivial(shape.n_verts)
    return KnownSymmetry(group, torch.zeros(shape.n_verts, dtype=torch.float64), "none", warnings or [])


def extrinsic_symmetry(shape: PreparedShape, max_residual: float = 0.02) -> KnownSymmetry:
    """The reflection in the best mirror plane, if the shape is its own mirror image up to ``max_residual``.

    Args:
        shape: the shape.
        max_residual: root mean square distance to the mirror image / sqrt(area) above which there is no plane.

    Returns:
        The reflection, with a warning if its residual is more than the triangulation explains; above ``max_residual``
        the trivial group, with a warning that gives the residual. Where several planes fit equally well they are in
        ``others``.

    References:
        Paper, sections 6.2 and 7.
    """
    found, *more = find_reflections(shape.mesh)
    if found.residual <= max_residual:
        first, *others = (_reflection(shape, plane) for plane in (found, *more) if plane.residual <= max_residual)
        return replace(first, others=tuple(others))
    text = f"{shape.mesh.label}: no mirror plane: the best one leaves a residual above {max_residual:g}"
    numbers, details = _numbers(found)
    none = no_symmetry(shape, [f"{text} ({numbers})"])
    return replace(none, details=details)


def _numbers(found: ExtrinsicReflection) -> tuple[str, dict[str, Any]]:
    """How well a plane fits, as text and for the summary."""
    text = f"rms {found.residual:.4f}, max {found.residual_max:.4f} of sqrt(area); vertex spacing {found.spacing:.4f}"
    details = {
        "residual": found.residual,
        "residual_max": found.residual_max,
        "spacing": found.spacing,
        "normal": found.normal.tolist(),
    }
    return text, details


def _reflection(shape: PreparedShape, found: ExtrinsicReflection) -> KnownSymmetry:
    numbers, details = _numbers(found)
    warnings = []
    if not found.convincing:
        warnings.append(f"{shape.mesh.label}: the mirror plane fits only roughly ({numbers})")
    # Not the sign of the side alone: on the axis that is rounding, and would differ with the units of the file.
    sign = halves_of_reflection(shape.mesh, found.map, found.side(shape.mesh.verts))
    return KnownSymmetry(SymmetryGroup.from_reflection(found.map), sign, "extrinsic", warnings, details)


def best_fitting(x: PreparedShape, y: PreparedShape, known_x: KnownSymmetry, known_y: KnownSymmetry) -> KnownSymmetry:
    """Of a shape's several reflections the one that belongs to the reflection of the other shape.

    Which of its planes comes first is chance. Of isometric shapes the quotients by matching reflections are isometric,
    so their symmetric functions have the same eigenvalues; the reflection is taken for which these differ least.

    Args:
        x: the shape with several reflections.
        y: the shape to match it to.
        known_x: the first of them, with its ``others``.
        known_y: the reflection of y.

    Returns:
        The reflection of x, with the relative differences of all in its ``details``.

    References:
        Paper, Lemma 3.2: the quotients of isometric shapes are isometric.
    """
    if not known_x.others or known_y.group.order != 2:
        return known_x
    k = min(N_COMPARED, x.basis.k, y.basis.k)
    wanted = symmetrized_basis(y.basis.truncate(k), known_y.group).even_evals
    choices = [known_x, *known_x.others]
    differences = []
    for choice in choices:
        own = symmetrized_basis(x.basis.truncate(k), choice.group).even_evals
        n = min(len(own), len(wanted))
        differences.append(float((own[:n] - wanted[:n]).norm() / wanted[:n].norm().clamp_min(1e-300)))
    best = choices[differences.index(min(differences))]
    details = best.details | {"reflections_tried": [round(value, 4) for value in differences]}
    return replace(best, warnings=known_x.warnings, details=details)


def detected_symmetry(shape: PreparedShape, parameters: MatchParameters) -> KnownSymmetry:
    """The reflection of a shape from its own spectrum (:func:`torchqm.matching.detect.detect_reflection`).

    Returns:
        The reflection, with a warning if the verdict is ``ambiguous``; the trivial group, with a warning, if it is
        ``asymmetric``. The verdict and its numbers are in ``details``.
    """
    found = detect_reflection(shape, parameters)
    details: dict[str, Any] = {"verdict": found.verdict, "candidates": found.candidates, **found.parts}
    origin = "detected" if found.group.order > 1 else "none"
    return KnownSymmetry(found.group, found.sign, origin, found.warnings, details)


def given_symmetry(shape: PreparedShape, maps: Tensor, origin: str = "file") -> KnownSymmetry:
    """A symmetry handed in as a table of vertex maps, row 0 the identity; left and right from its odd functions.

    Raises:
        MatchError: wrong length or ids, row 0 is not the identity, more than one reflection, or a map that is no
            reflection (:func:`torchqm.matching.symmetry_file.reflection_fault`).

    References:
        Paper, section 6.1; :func:`torchqm.matching.parity.odd_halves` instead of the clustering, which can fail.
    """
    if maps.ndim != 2 or maps.dtype != torch.int64:
        raise MatchError(
            f"the symmetry of {shape.mesh.label} must be a (G, V) table of int64 vertex ids, row 0 the identity; "
            f"got {maps.dtype} of shape {tuple(maps.shape)}"
        )
    if maps.shape[1] != shape.n_verts:
        raise MatchError(
            f"the symmetry has {maps.shape[1]} entries a row, but {shape.mesh.label} has {shape.n_verts} vertices"
        )
    group = SymmetryGroup(maps)
    if group.order == 1:
        return KnownSymmetry(group, torch.zeros_like(shape.basis.mass), origin)
    if group.order > 2:
        raise MatchError(
            f"{shape.mesh.label}: the symmetry has {group.order} elements; dense maps are extracted for one reflection "
            "(2 elements) so far"
        )
    reflection = group.maps[1]
    fault = reflection_fault(shape.mesh, reflection)
    if fault is not None:
        raise MatchError(f"{shape.mesh.label}: row 1 of the symmetry is no reflection: {fault}")
    small = shape.basis.truncate(min(60, shape.basis.k))
    halves = odd_halves(shape.mesh, small, nearest_involution(p2p_to_fmap(reflection, small, small)))
    sign = torch.where(halves * halves[reflection] < 0, halves, 0.0)
    return KnownSymmetry(group, sign, origin, [], {"involution_error": return_error(shape.mesh, reflection)})


def transferred_symmetry(
    shape: PreparedShape, reference: PreparedShape, known: KnownSymmetry, parameters: MatchParameters, way: str
) -> KnownSymmetry:
    """The symmetry of a shape from a reference whose reflection is known.

    Arguments as in :func:`torchqm.matching.transfer.transfer_symmetry`, whose numbers go into ``details``.
    """
    moved = transfer_symmetry(shape, reference, known.group, known.sign, parameters, way)
    details: dict[str, Any] = {"reference": reference.mesh.label, "way": way, "self_map_scores": list(moved.scores)}
    if moved.odd is not None:
        details |= {"residual_direct": moved.odd.residual_direct, "residual_mirrored": moved.odd.residual_mirrored}
    if moved.halves is not None:
        details |= {
            "persistence": list(moved.halves.persistence[:4]),
            "margin": moved.halves.margin if isfinite(moved.halves.margin) else None,
            "balance": moved.halves.balance,
        }
    warnings = [f"{shape.mesh.label}: {text}" for text in moved.warnings]
    return KnownSymmetry(moved.group, moved.sign, "transfer", warnings, details)
