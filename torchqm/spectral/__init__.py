"""Floor 2: eigenpairs of the Laplacian, bases of functions, and the descriptors that follow from them."""

from torchqm.spectral.basis import SpectralBasis, cluster_end
from torchqm.spectral.cache import (
    CachedBasis,
    CacheReport,
    CacheWarning,
    cache_folder,
    cached_basis,
    read_basis,
)
from torchqm.spectral.descriptors import (
    WaveEnergies,
    heat_kernel_signature,
    heat_kernel_values,
    heat_times,
    split_descriptors,
    unit_columns,
    wave_energies,
    wave_kernel_signature,
    wave_kernel_values,
)
from torchqm.spectral.eigen import SpectrumError, SpectrumWarning, eigenbasis, fix_signs, mesh_basis, relative_residuals
from torchqm.spectral.features import local_features, smooth_curvature
from torchqm.spectral.soft_map import SoftMap, soft_fmap

__all__ = [
    "CacheReport",
    "CacheWarning",
    "CachedBasis",
    "SoftMap",
    "SpectralBasis",
    "SpectrumError",
    "SpectrumWarning",
    "WaveEnergies",
    "cache_folder",
    "cached_basis",
    "cluster_end",
    "eigenbasis",
    "fix_signs",
    "heat_kernel_signature",
    "heat_kernel_values",
    "heat_times",
    "local_features",
    "mesh_basis",
    "read_basis",
    "relative_residuals",
    "smooth_curvature",
    "soft_fmap",
    "split_descriptors",
    "unit_columns",
    "wave_energies",
    "wave_kernel_signature",
    "wave_kernel_values",
]
