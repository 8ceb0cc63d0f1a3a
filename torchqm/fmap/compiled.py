"""Rows of functional maps by a kernel of our own in C (``rows.c``), where this installation has it.

It works on as many systems at a time as fit a vector register: 800 systems of a hundred rows are factored, checked and
solved in 5 ms on one core, where LAPACK's factors alone take 17 (``benchmarks/PROFILE.md``). ``pip install`` builds it
if there is a C compiler; else :mod:`torchqm.fmap.cholesky` does the same with LAPACK.
"""

import ctypes
from math import prod

import torch
from torch import Tensor

from torchqm.fmap.spare import SpareMemory
from torchqm.native import library

__all__ = ["KERNELS", "SPARE", "Kernel", "kernel_for"]

_NAMES = {torch.float32: ("float", ctypes.c_float), torch.float64: ("double", ctypes.c_double)}
# Numbers in the factors of a call from which on several threads gain more than they cost, in a solve that
# has them and in one that makes them. Measured.
_WORTH_THREADS = {"again": 2**23, "anew": 2**19}

SPARE = SpareMemory(2**26)
"""For factors of up to half of this; larger ones are asked for in large pages."""


class Kernel:
    """The functions of one type. Its factors are ``(n, groups, numbers)``: each sample has groups of its own.

    Args:
        built: the library, as ctypes has loaded it.
        dtype: float32 or float64.
    """

    def __init__(self, built: ctypes.CDLL, dtype: torch.dtype) -> None:
        name, real = _NAMES[dtype]
        self.dtype = dtype
        self.lanes, self._tile = getattr(built, f"lanes_{name}")(), built.tile()
        at, size = ctypes.c_void_p, ctypes.c_int64
        self._large_pages = built.large_pages
        self._solve, self._again = (getattr(built, f"{start}_{name}") for start in ("solve_rows", "solve_again"))
        self._solve.argtypes = [at, at, at, real, size, size, size, ctypes.c_int, at, at, at]
        self._again.argtypes = [at, at, size, size, size, ctypes.c_int, at]

    def factor_shape(self, n: int, ky: int, kx: int) -> tuple[int, int, int]:
        """Of the factors of ``ky`` rows of ``n`` samples. With symbolic sizes it is symbolic, too."""
        blocks = (kx + self._tile - 1) // self._tile
        groups = (ky + self.lanes - 1) // self.lanes
        return n, groups, self._tile**2 // 2 * blocks * (blocks + 1) * self.lanes

    def solve(
        self, gram: Tensor, diagonal: Tensor, rhs: Tensor, noise: float, keep: bool, threads: int | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The rows, which of them are undetermined, and the factors (empty unless kept).

        Args:
            gram: ``(n, Kx, Kx)`` of the kernel's type; what is below its diagonal is not used.
            diagonal: ``(n, Ky, Kx)``, of this type or another.
            rhs: ``(n, Ky, Kx)``, likewise.
            noise: below which share of its largest eigenvalue the smallest one of a system of unit diagonal counts as
                zero. 0: only those are undetermined that have no factor.
            keep: the factors.
            threads: at most so many; None: as many as torch has.
        """
        n, ky, kx = rhs.shape
        if gram.shape != (n, kx, kx) or diagonal.shape != rhs.shape:
            shapes = [tuple(tensor.shape) for tensor in (gram, diagonal, rhs)]
            raise ValueError(f"gram, diagonal, rhs: shapes {shapes} given, which do not fit")
        gram, diagonal, rhs = self._plain("gram", gram), self._plain("diagonal", diagonal), self._plain("rhs", rhs)
        shape = self.factor_shape(n, ky, kx)
        factor = self._room(shape) if keep else rhs.new_empty(0)
        rows, fine = torch.empty_like(rhs), torch.empty(n, ky, dtype=torch.bool, device=rhs.device)
        given = [tensor.data_ptr() for tensor in (gram, diagonal, rhs)]
        made = rows.data_ptr(), factor.data_ptr() if keep else None, fine.data_ptr()
        most = min(torch.get_num_threads(), n * shape[1], threads or n * shape[1])
        worth = most if prod(shape) >= _WORTH_THREADS["anew"] else 1
        _succeed(self._solve(*given, noise, n, kx, ky, worth, *made))
        return rows, ~fine, factor

    def solve_again(self, factor: Tensor, rhs: Tensor) -> Tensor:
        """The rows of the same systems for other right-hand sides ``(n, Ky, Kx)``."""
        n, ky, kx = rhs.shape
        if factor.shape != self.factor_shape(n, ky, kx):
            raise ValueError(f"factor: {tuple(factor.shape)} given, {self.factor_shape(n, ky, kx)} expected")
        factor, rhs = self._plain("factor", factor), self._plain("rhs", rhs)
        rows = torch.empty_like(rhs)
        threads = min(torch.get_num_threads(), n * factor.shape[1])
        worth = threads if factor.numel() >= _WORTH_THREADS["again"] else 1
        _succeed(self._again(factor.data_ptr(), rhs.data_ptr(), n, kx, ky, worth, rows.data_ptr()))
        return rows

    def _room(self, shape: tuple[int, int, int]) -> Tensor:
        """Memory for factors."""
        size = prod(shape) * self.dtype.itemsize
        if size <= SPARE.limit // 2:
            return SPARE.empty(shape, self.dtype)
        room = torch.empty(shape, dtype=self.dtype, device="cpu")
        self._large_pages(room.data_ptr(), size)
        return room

    def _plain(self, name: str, tensor: Tensor) -> Tensor:
        """As C reads it."""
        if tensor.device.type != "cpu":
            raise ValueError(f"{name}: is on {tensor.device}, the others on the CPU")
        return tensor.to(self.dtype).resolve_neg().contiguous()


def kernel_for(device: torch.device, dtype: torch.dtype) -> Kernel | None:
    """The kernel for tensors like these; None where there is none, or where LAPACK is faster.

    Example:
        >>> kernel_for(torch.device("cpu"), torch.half) is None
        True
    """
    return KERNELS.get(dtype) if device.type == "cpu" else None


def _kernels() -> dict[torch.dtype, Kernel]:
    built = library("fmap/_rows")
    return {} if built is None else {dtype: Kernel(built, dtype) for dtype in _NAMES}


def _succeed(failed: int) -> None:
    if failed:
        raise MemoryError("no memory for the factor of a functional map's rows")


KERNELS = _kernels()
"""By type; made at once and not when they are asked for, so that ``torch.compile`` can look them up."""
