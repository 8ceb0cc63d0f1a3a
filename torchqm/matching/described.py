"""The descriptors that two shapes share, as coefficients: computed once a pair, whoever asks."""

from dataclasses import dataclass, field
from functools import partial
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.threads import in_parallel
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.shape import PreparedShape
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.descriptors import (
    WaveEnergies,
    heat_kernel_signature,
    heat_times,
    wave_energies,
    wave_kernel_signature,
)
from torchqm.spectral.splitting import Splitting

__all__ = ["PairDescriptors", "pair_descriptors"]

_ROWS = 4096  # of a block of signatures


@dataclass(frozen=True, eq=False)
class PairDescriptors:
    """The split descriptors of two shapes in their first functions; see :func:`pair_descriptors`.

    The symmetric functions are combinations of the full basis, so these coefficients give theirs, too: ``U^T F``.

    Args:
        coefficients: ``(K, C)`` of the first and of the second shape.
        splitting: their common intervals of values.
        scale: their common energies (``wks``) or times (``hks``).
        n_functions: functions of which the signatures are made.
    """

    coefficients: tuple[Float[Tensor, "Kx C"], Float[Tensor, "Ky C"]]
    splitting: Splitting
    scale: WaveEnergies | Float[Tensor, " n"] = field(repr=False)
    n_functions: int

    def swapped(self) -> "PairDescriptors":
        """The same with the second shape first."""
        return PairDescriptors(self.coefficients[::-1], self.splitting, self.scale, self.n_functions)

    def weighted(self, x: PreparedShape, k: int, factor: Float[Tensor, " V"]) -> Float[Tensor, "K C"]:
        """Coefficients, in the first ``k`` functions of a shape, of its descriptors times a function.

        Args:
            x: one of the two shapes.
            k: functions.
            factor: one number a vertex, such as the sign that tells left from right.
        """
        # Blocks of vertices at the same time. Where a vertex has no area, its weights are 0, so its signature is free.
        parts = zip(x.basis.evecs.split(_ROWS), (x.basis.mass * factor).split(_ROWS), strict=True)
        evals = x.basis.evals[: self.n_functions]

        def of_block(evecs: Tensor, weights: Tensor) -> Tensor:
            values = _signature(SpectralBasis(evals, evecs[:, : self.n_functions], weights), self.scale)
            return self.splitting.coefficients(values, evecs[:, :k] * weights[:, None])

        return torch.stack(in_parallel([partial(of_block, *part) for part in parts])).sum(0)


_Key = tuple[object, ...]
_KEPT: WeakKeyDictionary[PreparedShape, WeakKeyDictionary[PreparedShape, dict[_Key, PairDescriptors]]]
_KEPT = WeakKeyDictionary()  # of the last pair alone: 240 KB at 30 functions, and a collection may have many pairs


def pair_descriptors(x: PreparedShape, y: PreparedShape, parameters: MatchParameters, k: int = 0) -> PairDescriptors:
    """Coefficients of :func:`torchqm.matching.initial.shared_descriptors` in the first functions of two shapes.

    Symmetry transfer and the matching after it ask for the same ones; they are kept with the shapes.

    Args:
        x: one shape.
        y: the other.
        parameters: ``k``, ``k_max`` and the numbers of the descriptors are used.
        k: functions if more than ``parameters.k`` are wanted; each shape gives as many as it has.
    """
    k = max(k, parameters.k)
    n_functions = min(parameters.k_max, x.basis.k, y.basis.k)
    key = (k, n_functions, parameters.descriptor, parameters.n_descriptors, parameters.splits)
    for first, second in ((x, y), (y, x)):
        kept = _KEPT.get(first)
        found = None if kept is None else kept.get(second, {}).get(key)
        if found is not None:
            return found if first is x else found.swapped()
    found = _computed(x, y, parameters, n_functions, k)
    if y not in _KEPT.get(x, {}):
        _KEPT.clear()
    _KEPT.setdefault(x, WeakKeyDictionary()).setdefault(y, {})[key] = found
    return found


def _computed(
    x: PreparedShape, y: PreparedShape, parameters: MatchParameters, n_functions: int, k: int
) -> PairDescriptors:
    bases = [s.basis.truncate(n_functions) for s in (x, y)]
    scale: WaveEnergies | Tensor
    if parameters.descriptor == "wks":
        scale = wave_energies(bases, parameters.n_descriptors)
    else:
        scale = heat_times(bases, parameters.n_descriptors)
    values = in_parallel([partial(_signatures, b, scale) for b in bases])
    splitting = Splitting.of(values, parameters.splits)
    weights = [s.basis.evecs[:, :k] * s.basis.mass[:, None] for s in (x, y)]
    first, second = in_parallel([partial(splitting.coefficients, v, w) for v, w in zip(values, weights, strict=True)])
    return PairDescriptors((first, second), splitting, scale, n_functions)


def _signatures(basis: SpectralBasis, scale: WaveEnergies | Tensor) -> Float[Tensor, "V C"]:
    """Signatures at all vertices, by blocks; where a vertex has no area, the least of the others."""
    starts = range(0, basis.n_verts, _ROWS)
    parts = [SpectralBasis(basis.evals, basis.evecs[i : i + _ROWS], basis.mass[i : i + _ROWS]) for i in starts]
    values = torch.cat([_signature(part, scale) for part in parts])
    used = basis.mass > 0
    if not bool(used.all()):
        # Eigenfunctions are 0 there; that is no value of the shape, and must not widen the ranges.
        values = torch.where(used[:, None], values, values[used].amin(0))
    return values


def _signature(basis: SpectralBasis, scale: WaveEnergies | Tensor) -> Float[Tensor, "V C"]:
    return (
        wave_kernel_signature(basis, scale) if isinstance(scale, WaveEnergies) else heat_kernel_signature(basis, scale)
    )
