"""Floor 2: eigenpairs of the Laplacian, bases of functions, and the descriptors that follow from them."""

from torchqm.spectral.basis import SpectralBasis, cluster_end
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

__all__ = [
    "SpectralBasis",
    "SpectrumError",
    "WaveEnergies",
    "cluster_end",
    "eigenbasis",
    "fix_signs",
    "heat_kernel_signature",
    "heat_times",
    "mesh_basis",
    "relative_residuals",
    "split_descriptors",
    "unit_columns",
    "wave_energies",
    "wave_kernel_signature",
]
