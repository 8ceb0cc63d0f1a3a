"""Nearest descriptors: each vertex goes to the vertex whose wave kernel signature is most like its own.

The floor that every matcher should pass. Intrinsic descriptors are the same left and right, so which of the two comes
back is a matter of noise.

References:
    Aubry, Schlickewei, Cremers. The wave kernel signature. ICCV Workshops 2011.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchqm.fmap.nearest import nearest_rows
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result, shared_size
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps
from torchqm.spectral.descriptors import (
    heat_kernel_signature,
    heat_times,
    wave_energies,
    wave_kernel_signature,
)

__all__ = ["NearestDescriptors"]


@dataclass(frozen=True)
class NearestDescriptors:
    """``descriptors``: the nearest row of wave (or heat) kernel signatures, each column scaled to unit deviation.

    Args:
        kind: ``wks`` or ``hks``.
        n: energies or times.
        k: eigenfunctions in the signatures, at most.
        name: in tables.
        needs: see :class:`torchqm.matching.baselines.Matcher`.

    Raises:
        ValueError: an unknown kind or fewer than 2 columns.
    """

    kind: str = "wks"
    n: int = 100
    k: int = 200
    name: str = "descriptors"
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in ("wks", "hks"):
            raise ValueError(f"kind={self.kind!r}: allowed are wks, hks")
        if self.n < 2:
            raise ValueError(f"n={self.n}: at least 2 energies or times are needed")

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """One map; see :class:`torchqm.matching.baselines.Matcher`."""
        given.check(x, y)
        steps = Steps()
        k = shared_size(x, y, self.k)
        bases = [x.basis.truncate(k), y.basis.truncate(k)]
        with steps("descriptors"):
            if self.kind == "wks":
                energies = wave_energies(bases, self.n)
                values = [wave_kernel_signature(basis, energies) for basis in bases]
            else:
                times = heat_times(bases, self.n)
                values = [heat_kernel_signature(basis, times) for basis in bases]
            scale = _deviation(values, [x.basis.mass, y.basis.mass])
        with steps("point map"):
            used = (y.basis.mass > 0).nonzero().flatten()
            p2p = used[nearest_rows(values[0] / scale, values[1][used] / scale)]
        return make_result(self.name, x, y, p2p, steps, k=k)


def _deviation(values: list[Tensor], mass: list[Tensor]) -> Tensor:
    """Root mean square deviation of each column over both surfaces."""
    weights = [m / m.sum() / len(mass) for m in mass]
    mean = sum((w @ v for v, w in zip(values, weights, strict=True)), torch.zeros_like(values[0][0]))
    square = sum((w @ (v - mean).square() for v, w in zip(values, weights, strict=True)), torch.zeros_like(mean))
    return square.sqrt().clamp_min(torch.finfo(mean.dtype).tiny)
