"""Floor 6: layers that drop into a learned pipeline; each holds options and calls functions of the lower floors.

Shapes are those of a padded batch: features ``(B, V, C)``, ``evals (B, K)``, ``evecs (B, V, K)``, ``evecs_trans
(B, K, V)``, ``mass (B, V)``, functional maps ``(B, Ky, Kx)``; masks say what is real.
:func:`torchqm.checks.disabled` switches the checks of values off.
"""

from torchqm.nn.basis import SymmetrizedBasis
from torchqm.nn.descriptors import HeatKernelSignature, OrientationDescriptors, WaveKernelSignature
from torchqm.nn.diffusion_net import DiffusionNet
from torchqm.nn.features import MLP, InputFeatures
from torchqm.nn.loss import FunctionalMapLoss, OrbitConsistencyLoss, PointToOrbitLoss
from torchqm.nn.refine import QuotientICP, SpectralUpsampling
from torchqm.nn.soft_map import Similarity, SoftPointMap
from torchqm.nn.solver import FunctionalMapSolver

__all__ = [
    "MLP",
    "DiffusionNet",
    "FunctionalMapLoss",
    "FunctionalMapSolver",
    "HeatKernelSignature",
    "InputFeatures",
    "OrbitConsistencyLoss",
    "OrientationDescriptors",
    "PointToOrbitLoss",
    "QuotientICP",
    "Similarity",
    "SoftPointMap",
    "SpectralUpsampling",
    "SymmetrizedBasis",
    "WaveKernelSignature",
]
