"""Floor 3: symmetry groups acting on a shape, even and odd functions, mirror planes, left and right."""

from torchqm.symmetry.algebra import (
    central_idempotents,
    conjugacy_classes,
    element_orders,
    group_fault,
    group_name,
    inverses,
    real_degrees,
    subgroup,
)
from torchqm.symmetry.basis import SymmetrizedBasis, split_by_projector, symmetrized_basis
from torchqm.symmetry.domains import FundamentalDomains, fundamental_domains
from torchqm.symmetry.extrinsic import (
    ExtrinsicGroup,
    ExtrinsicReflection,
    extrinsic_group,
    find_reflection,
    find_reflections,
)
from torchqm.symmetry.group import GroupResiduals, SymmetryGroup
from torchqm.symmetry.irreducible import IsotypicComponent, isotypic_components
from torchqm.symmetry.leftright import LeftRight, displacement, halves_of_reflection, persistence_clusters
from torchqm.symmetry.orientation import (
    function_pairs,
    orientation_coefficients,
    orientation_cosine,
    orientation_descriptors,
    orientation_form,
    orientation_tensor,
)
from torchqm.symmetry.projection import even_part, odd_part, projection_matrix

__all__ = [
    "ExtrinsicGroup",
    "ExtrinsicReflection",
    "FundamentalDomains",
    "GroupResiduals",
    "IsotypicComponent",
    "LeftRight",
    "SymmetrizedBasis",
    "SymmetryGroup",
    "central_idempotents",
    "conjugacy_classes",
    "displacement",
    "element_orders",
    "even_part",
    "extrinsic_group",
    "find_reflection",
    "find_reflections",
    "function_pairs",
    "fundamental_domains",
    "group_fault",
    "group_name",
    "halves_of_reflection",
    "inverses",
    "isotypic_components",
    "odd_part",
    "orientation_coefficients",
    "orientation_cosine",
    "orientation_descriptors",
    "orientation_form",
    "orientation_tensor",
    "persistence_clusters",
    "projection_matrix",
    "real_degrees",
    "split_by_projector",
    "subgroup",
    "symmetrized_basis",
]
