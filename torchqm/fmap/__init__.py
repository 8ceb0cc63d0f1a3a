"""Floor 4: functional maps - their energies, the solver, refinement, conversion to point maps and back."""

from torchqm.fmap.commutativity import commutativity_mask
from torchqm.fmap.convert import deltas, fmap_to_p2p, nearest_used, p2p_to_fmap
from torchqm.fmap.energy import (
    commutativity_energy,
    commutativity_weights,
    descriptor_energy,
    orthogonality_energy,
)
from torchqm.fmap.fmap_losses import bijectivity_energy, surfmnet_losses
from torchqm.fmap.nearest import nearest_rows
from torchqm.fmap.orbit_consistency import inner_pairings, orbit_consistency_fmap, orbit_consistency_points
from torchqm.fmap.orbit_loss import (
    assignment_orbit_loss,
    distance_orbit_loss,
    map_orbit_loss,
    spectral_orbit_loss,
)
from torchqm.fmap.orbit_truth import orbit_members
from torchqm.fmap.polar import nearest_isometry
from torchqm.fmap.refine import (
    correspondence_fmap,
    frequency_mask,
    growing_sizes,
    quotient_icp,
    semi_quotient_icp,
    semi_upsample,
    upsample,
)
from torchqm.fmap.regularized import descriptor_coefficients, regularized_blocks, regularized_fmap
from torchqm.fmap.soft import feature_neighbours, soft_assignment, soft_map
from torchqm.fmap.solve import solve_fmap
from torchqm.fmap.surface_search import SurfaceSearch
from torchqm.fmap.two_way import Places, growing_pairs, two_way_upsample
from torchqm.fmap.unrolled import soft_icp, soft_upsample

__all__ = [
    "Places",
    "SurfaceSearch",
    "assignment_orbit_loss",
    "bijectivity_energy",
    "commutativity_energy",
    "commutativity_mask",
    "commutativity_weights",
    "correspondence_fmap",
    "deltas",
    "descriptor_coefficients",
    "descriptor_energy",
    "distance_orbit_loss",
    "feature_neighbours",
    "fmap_to_p2p",
    "frequency_mask",
    "growing_pairs",
    "growing_sizes",
    "inner_pairings",
    "map_orbit_loss",
    "nearest_isometry",
    "nearest_rows",
    "nearest_used",
    "orbit_consistency_fmap",
    "orbit_consistency_points",
    "orbit_members",
    "orthogonality_energy",
    "p2p_to_fmap",
    "quotient_icp",
    "regularized_blocks",
    "regularized_fmap",
    "semi_quotient_icp",
    "semi_upsample",
    "soft_assignment",
    "soft_icp",
    "soft_map",
    "soft_upsample",
    "solve_fmap",
    "spectral_orbit_loss",
    "surfmnet_losses",
    "two_way_upsample",
    "upsample",
]
