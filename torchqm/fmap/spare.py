"""Memory of factors that is used again by the next step of a training, instead of being fetched from the system."""

import sys
from math import prod
from threading import Lock

import numpy as np
import torch
from torch import Tensor

__all__ = ["SpareMemory"]


class SpareMemory:
    """Gives out tensors whose memory is kept, up to a limit, when nobody holds them any more.

    What malloc gives back to the system comes again as new pages, each of which is cleared when it is first written to:
    for the factors of a hundred functions that takes as long as making them.

    Args:
        limit: bytes that are kept at most.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._arrays: list[np.ndarray] = []
        self._lock = Lock()

    def empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """A tensor on the CPU, its entries undefined.

        Example:
            >>> spare = SpareMemory(2**20)
            >>> first = spare.empty((4, 5), torch.float32)
            >>> address = first.data_ptr()
            >>> spare.empty((4, 5), torch.float32).data_ptr() == address  # somebody holds it
            False
            >>> del first
            >>> spare.empty((5, 4), torch.float32).data_ptr() == address
            True
        """
        size = prod(shape) * dtype.itemsize
        with self._lock:
            array = next((a for a in self._free() if a.nbytes == size), None)
            if array is None:
                array = np.empty(size, dtype=np.uint8)
                self._keep(array)
            # The tensor's memory holds the array as long as there is any view of it.
            return torch.from_numpy(array).view(dtype).view(shape)

    def clear(self) -> None:
        """Give back what nobody holds."""
        with self._lock:
            self._arrays = []

    def _free(self) -> list[np.ndarray]:
        counts = _references(self._arrays)
        return [array for array, count in zip(self._arrays, counts, strict=True) if count == _ALONE]

    def _keep(self, array: np.ndarray) -> None:
        """Keep the latest, as many as the limit allows."""
        kept: list[np.ndarray] = []
        for candidate in (array, *reversed(self._arrays)):
            if sum(a.nbytes for a in kept) + candidate.nbytes <= self.limit:
                kept.append(candidate)
        self._arrays = kept[::-1]


def _references(arrays: list[np.ndarray]) -> list[int]:
    return [sys.getrefcount(array) for array in arrays]


# What an array counts that only such a list holds; how many of them are this function's own differs between Pythons.
_ALONE = _references([np.empty(1)])[0]
