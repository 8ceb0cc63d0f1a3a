"""Where a shape's symmetry comes from: its mirror planes, its spectrum, the user, or a reference shape."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import p2p_to_fmap
from torchqm.matching.detect import detect_group
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.parity import odd_halves
from torchqm.matching.quality import orientation_agreement
from torchqm.matching.self_map import nearest_involution
from torchqm.matching.shape import PreparedShape, complete
from torchqm.matching.symmetry_file import closure_fault, reflection_fault, return_error
from torchqm.matching.transfer import transfer_symmetry
from torchqm.symmetry.algebra import group_name
from torchqm.symmetry.extrinsic import ExtrinsicReflection, extrinsic_group, find_reflections
from torchqm.symmetry.group import SymmetryGroup
from torchqm.symmetry.leftright import halves_of_reflection

__all__ = [
    "KnownSymmetry",
    "detected_symmetry",
    "extrinsic_symmetry",
    "given_symmetry",
    "no_symmetry",
    "transferred_symmetry",
]


@dataclass(frozen=True, eq=False)
class KnownSymmetry:
    """A symmetry group, with the left-right map that goes with it where it is one reflection.

    Args:
        group: the group; trivial if the shape has no symmetry that is known.
        sign: ``(V,)`` of one reflection: -1 on one half, +1 on the other, 0 on the axis; all 0 for other groups.
        origin: ``extrinsic``, ``detected``, ``file``, ``transfer`` or ``none``.
        warnings: what is doubtful, with the numbers.
        details: numbers for the summary.
        table: multiplication table ``(G, G)``; not needed for groups of one or two elements.
        turned: ``(G,)`` +1 where an element keeps the orientation of the surface, -1 where it turns it over; by default
            the second element of a pair is a reflection.
    """

    group: SymmetryGroup
    sign: Float[Tensor, " V"]
    origin: str
    warnings: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    table: Int[Tensor, "G G"] | None = None
    turned: Float[Tensor, " G"] | None = None

    @property
    def known(self) -> bool:
        """Whether there is more than the identity."""
        return self.group.order > 1

    @property
    def firm(self) -> bool:
        """Whether it is known without a doubt: a better source for a transfer than a doubtful symmetry of one's own."""
        return self.known and not self.warnings

    @property
    def reflection(self) -> bool:
        """Whether it is one reflection: what the paper's own way is made for."""
        return self.group.order == 2 and float(self.orientation[1]) < 0

    @cached_property
    def products(self) -> Int[Tensor, "G G"]:
        """Which element is ``g o h``."""
        if self.table is not None:
            return self.table
        order = self.group.order
        if order > 2:
            raise ValueError(f"table: needed for a group of {order} elements")
        return torch.arange(order)[:, None] ^ torch.arange(order)

    @cached_property
    def orientation(self) -> Float[Tensor, " G"]:
        """+1 and -1, see ``turned``."""
        if self.turned is not None:
            return self.turned
        return torch.tensor([1.0, -1.0][: self.group.order], dtype=torch.float64)

    @property
    def name(self) -> str:
        """Of the group, such as ``C2``: see :func:`torchqm.symmetry.algebra.group_name`."""
        return group_name(self.products)

    def subset(self, elements: Sequence[int], shape: PreparedShape, details: dict[str, Any]) -> "KnownSymmetry":
        """A subgroup, element 0 first, with its own left and right if it is a reflection.

        Args:
            elements: which.
            shape: the shape.
            details: more numbers.
        """
        chosen = list(elements)
        if len(chosen) == self.group.order:
            return replace(self, details=self.details | details)
        group, orientation = self.group.subset(chosen), self.orientation[chosen]
        number = torch.full((self.group.order,), -1, dtype=torch.int64)
        number[chosen] = torch.arange(len(chosen))
        sign = torch.zeros_like(self.sign)
        if group.order == 2 and float(orientation[1]) < 0:
            sign = _halves(shape, group.maps[1])
        table = number[self.products[chosen][:, chosen]]
        return KnownSymmetry(group, sign, self.origin, self.warnings, self.details | details, table, orientation)


def _halves(shape: PreparedShape, reflection: Int[Tensor, " V"]) -> Float[Tensor, " V"]:
    """Left and right of a reflection from its odd functions; 0 where the two do not change places."""
    small = shape.basis.truncate(min(60, shape.basis.k))
    halves = odd_halves(shape.mesh, small, nearest_involution(p2p_to_fmap(reflection, small, small)))
    return torch.where(halves * halves[reflection] < 0, halves, 0.0)


def no_symmetry(shape: PreparedShape, warnings: list[str] | None = None) -> KnownSymmetry:
    """The trivial group: the shape goes through the same code and gives one map."""
    group = SymmetryGroup.trivial(shape.n_verts)
    return KnownSymmetry(group, torch.zeros(shape.n_verts, dtype=torch.float64), "none", warnings or [])


def extrinsic_symmetry(shape: PreparedShape, max_residual: float = 0.02) -> KnownSymmetry:
    """The group that the mirror planes generate in which the shape is its own mirror image up to ``max_residual``.

    Args:
        shape: the shape.
        max_residual: root mean square distance to the mirror image / sqrt(area) above which there is no plane.

    Returns:
        The reflection, or the group that several planes generate; with a warning if the residual of the best plane is
        more than the triangulation explains. Above ``max_residual`` the trivial group, with a warning that gives the
        residual.

    References:
        Paper, sections 6.2 and 7.
    """
    found, *more = find_reflections(shape.mesh)
    if found.residual <= max_residual:
        planes = [found, *(plane for plane in more if plane.residual <= max_residual)]
        known = _reflection(shape, found)
        return known if len(planes) == 1 or not found.convincing else _several(shape, known, planes, max_residual)
    text = f"{shape.mesh.label}: no mirror plane: the best one leaves a residual above {max_residual:g}"
    numbers, details = _numbers(found)
    none = no_symmetry(shape, [f"{text} ({numbers})"])
    return replace(none, details=details)


def _several(
    shape: PreparedShape, first: KnownSymmetry, planes: list[ExtrinsicReflection], max_residual: float
) -> KnownSymmetry:
    """The group of several planes; the first reflection alone, with a warning, where they make no finite group."""
    name = shape.mesh.label
    try:
        found = extrinsic_group(shape.mesh, planes)
    except ValueError as error:
        return replace(first, warnings=[*first.warnings, f"{error}; one reflection is used"])
    residuals = found.group.residuals(shape.mesh.verts, shape.mesh.vertex_areas)
    if found.residual > 2 * max_residual or not residuals.is_group:
        text = f"{name}: {len(planes)} mirror planes fit, but not all their products; one reflection is used"
        return replace(first, warnings=[*first.warnings, f"{text} (residual {found.residual:.4f})"])
    details = first.details | {"planes": len(planes), "group": residuals.name, "residual_of_products": found.residual}
    return KnownSymmetry(
        found.group,
        torch.zeros_like(first.sign),
        "extrinsic",
        first.warnings,
        details,
        residuals.products,
        found.orientation,
    )


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


def detected_symmetry(shape: PreparedShape, parameters: MatchParameters) -> KnownSymmetry:
    """The symmetries of a shape from its own spectrum (:func:`torchqm.matching.detect.detect_group`).

    Returns:
        The group, with a warning if the verdict is ``ambiguous``; the trivial group, with a warning, if it is
        ``asymmetric``. The verdict and its numbers are in ``details``.
    """
    found = detect_group(shape, parameters)
    details: dict[str, Any] = {"verdict": found.verdict, "group": found.name, "candidates": found.candidates}
    details |= found.parts
    origin = "detected" if found.group.order > 1 else "none"
    return KnownSymmetry(
        found.group, found.sign, origin, found.warnings, details, found.products, found.orientation[: found.group.order]
    )


def given_symmetry(shape: PreparedShape, maps: Tensor, origin: str = "file") -> KnownSymmetry:
    """A symmetry handed in as a table of vertex maps, row 0 the identity.

    Raises:
        MatchError: wrong length or ids, row 0 is not the identity, a pair whose second map is no reflection
            (:func:`torchqm.matching.symmetry_file.reflection_fault`), or more maps that are no group.

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
    none = torch.zeros_like(shape.basis.mass)
    if group.order == 1:
        return KnownSymmetry(group, none, origin)
    if group.order > 2:
        return _given_group(shape, group, origin)
    reflection = group.maps[1]
    fault = reflection_fault(shape.mesh, reflection, half_turns=True)
    if fault is not None:
        raise MatchError(f"{shape.mesh.label}: row 1 of the symmetry is no reflection: {fault}")
    if shape.oriented and orientation_agreement(shape.mesh, shape.mesh, reflection) > 0.3:
        return _given_group(shape, group, origin)
    error = return_error(shape.mesh, reflection)
    return KnownSymmetry(group, _halves(shape, reflection), origin, [], {"involution_error": error})


def _given_group(shape: PreparedShape, group: SymmetryGroup, origin: str) -> KnownSymmetry:
    """A table of more than two maps, or of the identity and a half turn, if it is closed under composition."""
    fault, residuals = closure_fault(shape.mesh, group)
    if fault is not None:
        raise MatchError(f"{shape.mesh.label}: the {group.order} maps of the symmetry are no group: {fault}")
    agreement = [orientation_agreement(shape.mesh, shape.mesh, row) if shape.oriented else 1.0 for row in group.maps]
    turned = torch.tensor([-1.0 if value < 0 else 1.0 for value in agreement], dtype=torch.float64)
    details = {"group": residuals.name, "closure": residuals.closure, "inverse": residuals.inverse}
    return KnownSymmetry(group, torch.zeros_like(shape.basis.mass), origin, [], details, residuals.products, turned)


def transferred_symmetry(
    shape: PreparedShape, reference: PreparedShape, known: KnownSymmetry, parameters: MatchParameters, way: str
) -> KnownSymmetry:
    """The symmetry of a shape from a reference whose reflection is known.

    Arguments as in :func:`torchqm.matching.transfer.transfer_symmetry`, whose numbers go into ``details``.
    """
    complete((shape, reference), parameters.local_weight > 0)
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
