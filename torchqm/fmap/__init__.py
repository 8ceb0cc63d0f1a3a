"""Floor 4: functional maps - their energies, the solver, refinement, conversion to point maps and back."""

from torchqm.fmap.convert import deltas, fmap_to_p2p, nearest_used, p2p_to_fmap
from torchqm.fmap.energy import (
    commutativity_energy,
    commutativity_weights,
    descriptor_energy,
    orthogonality_energy,
)
from torchqm.fmap.nearest import SurfaceSearch, nearest_rows
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
from torchqm.fmap.solve import solve_fmap
from torchqm.fmap.two_way import Places, growing_pairs, two_way_upsample

__all__ = [
    "Places",
    "SurfaceSearch",
    "commutativity_energy",
    "commutativity_weights",
    "correspondence_fmap",
    "deltas",
    "descriptor_energy",
    "fmap_to_p2p",
    "frequency_mask",
    "growing_pairs",
    "growing_sizes",
    "nearest_isometry",
    "nearest_rows",
    "nearest_used",
    "orthogonality_energy",
    "p2p_to_fmap",
    "quotient_icp",
    "semi_quotient_icp",
    "semi_upsample",
    "solve_fmap",
    "two_way_upsample",
    "upsample",
]
