"""Floor 3: symmetry groups acting on a shape, even and odd functions, mirror planes, left and right."""

from torchqm.symmetry.basis import SymmetrizedBasis, split_by_projector, symmetrized_basis
from torchqm.symmetry.extrinsic import ExtrinsicReflection, find_reflection, find_reflections
from torchqm.symmetry.group import GroupResiduals, SymmetryGroup, common_order
from torchqm.symmetry.leftright import LeftRight, displacement, halves_of_reflection, persistence_clusters
from torchqm.symmetry.orientation import function_pairs, orientation_coefficients, orientation_form
from torchqm.symmetry.projection import even_part, odd_part, projection_matrix

__all__ = [
    "ExtrinsicReflection",
    "GroupResiduals",
    "LeftRight",
    "SymmetrizedBasis",
    "SymmetryGroup",
    "common_order",
    "displacement",
    "even_part",
    "find_reflection",
    "find_reflections",
    "function_pairs",
    "halves_of_reflection",
    "odd_part",
    "orientation_coefficients",
    "orientation_form",
    "persistence_clusters",
    "projection_matrix",
    "split_by_projector",
    "symmetrized_basis",
]
