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
    heat_times,
    split_descriptors,
    unit_columns,
    wave_energies,
    wave_kernel_signature,
)
from torchqm.spectral.eigen import SpectrumError, eigenbasis, fix_signs, mesh_basis, relative_residuals
from torchqm.spectral.features import local_features, smooth_curvature

__all__ = [
    "CacheReport",
    "CacheWarning",
    "CachedBasis",
    "SpectralBasis",
    "SpectrumError",
    "WaveEnergies",
    "cache_folder",
    "cached_basis",
    "cluster_end",
    "eigenbasis",
    "fix_signs",
    "heat_kernel_signature",
    "heat_times",
    "local_features",
    "mesh_basis",
    "read_basis",
    "relative_residuals",
    "smooth_curvature",
    "split_descriptors",
    "unit_columns",
    "wave_energies",
    "wave_kernel_signature",
]
