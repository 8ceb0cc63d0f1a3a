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
from torchqm.symmetry.basis import EvenOddBasis, split_by_projector, symmetrized_basis
from torchqm.symmetry.domains import FundamentalDomains, fundamental_domains
from torchqm.symmetry.extrinsic import (
    ExtrinsicGroup,
    ExtrinsicReflection,
    extrinsic_group,
    find_reflection,
    find_reflections,
)
from torchqm.symmetry.group import GroupResiduals, SymmetryGroup
from torchqm.symmetry.halves import symmetrized_projector
from torchqm.symmetry.invariant import invariant_eigh, spectral_projector, split_eigh
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
from torchqm.symmetry.soft import projection_matrices
from torchqm.symmetry.split import SplitBases, split_bases, symmetrized_bases

__all__ = [
    "EvenOddBasis",
    "ExtrinsicGroup",
    "ExtrinsicReflection",
    "FundamentalDomains",
    "GroupResiduals",
    "IsotypicComponent",
    "LeftRight",
    "SplitBases",
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
    "invariant_eigh",
    "inverses",
    "isotypic_components",
    "odd_part",
    "orientation_coefficients",
    "orientation_cosine",
    "orientation_descriptors",
    "orientation_form",
    "orientation_tensor",
    "persistence_clusters",
    "projection_matrices",
    "projection_matrix",
    "real_degrees",
    "spectral_projector",
    "split_bases",
    "split_by_projector",
    "split_eigh",
    "subgroup",
    "symmetrized_bases",
    "symmetrized_basis",
    "symmetrized_projector",
]
