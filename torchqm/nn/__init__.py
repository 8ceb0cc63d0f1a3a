"""Floor 6: layers that drop into a learned pipeline; each holds options and calls functions of the lower floors."""

from torchqm.nn.basis import SymmetrizedBasis
from torchqm.nn.descriptors import HeatKernelSignature, OrientationDescriptors, WaveKernelSignature

__all__ = ["HeatKernelSignature", "OrientationDescriptors", "SymmetrizedBasis", "WaveKernelSignature"]
