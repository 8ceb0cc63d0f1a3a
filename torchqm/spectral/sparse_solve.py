"""Solves with a shifted sparse matrix for many right-hand sides: our own on all cores, or cholespy's.

cholespy (CHOLMOD) factors and solves on one core, holding Python's lock. Where our solves are built (``ldl.c``), qdldl
makes the factor, and they work in its order of the vertices: whole runs stay in that order, so nothing is moved around.
"""

import ctypes
from abc import ABC, abstractmethod
from importlib.util import find_spec
from threading import Lock

import numpy as np
import scipy
import torch
from torch import Tensor

from torchqm.native import library

__all__ = ["Factor", "FactorError", "factorize"]

_COLUMNS = {"cpu": 8, "cuda": 64}
# Right-hand sides of one call of cholespy: 0.5 ms each at 28k vertices on a CPU, with 200 in one call 0.9 ms; a GPU
# takes 128.


class FactorError(RuntimeError):
    """The matrix has no Cholesky factor, or none was found."""


class Factor(ABC):
    """Solves with ``A + shift``."""

    order: np.ndarray | None = None
    """``(n,)`` which vertex each column of the rows below belongs to; None: they are as in the matrix."""

    @abstractmethod
    def filtered(self, rows: Tensor, centre: float = 0.0, times: int = 1) -> Tensor:
        """``((A + shift)^-1 - centre)^times`` of each row ``(m, n)``."""


def factorize(matrix: "scipy.sparse.csc_array", shift: float, device: torch.device) -> Factor:
    """Factor ``A + shift`` of a symmetric ``A``, which must be positive definite.

    Raises:
        FactorError: it is not.
    """
    shifted = scipy.sparse.csc_array(matrix + shift * scipy.sparse.eye_array(matrix.shape[0], format="csc"))
    shifted.sort_indices()
    there = device.type == "cpu" and find_spec("qdldl") is not None
    built = library("spectral/_ldl") if there else None
    return _Cholespy(shifted, device) if built is None else _Ours(shifted, built)


class _Ours(Factor):
    """``P (A + shift) P^T = L D L^T`` by qdldl, sweeps by us."""

    def __init__(self, matrix: "scipy.sparse.csc_array", built: ctypes.CDLL) -> None:
        import qdldl

        try:
            lower, diagonal, order = qdldl.Solver(scipy.sparse.csc_matrix(matrix)).factors()
        except (RuntimeError, ValueError) as error:
            raise FactorError(f"no Cholesky factor: {error}") from error
        if not (diagonal > 0).all():
            raise FactorError(f"no Cholesky factor: {int((~(diagonal > 0)).sum())} pivots are not positive")
        self.order, self._n = order, matrix.shape[0]
        # Kept as long as their addresses are used.
        self._lower = (lower.indptr.astype(np.int64), lower.indices.astype(np.int32), lower.data, 1 / diagonal)
        self._apply, self._width = built.apply, built.width()
        at, size = ctypes.c_void_p, ctypes.c_int64
        integer = ctypes.c_int
        self._apply.argtypes = [size, at, at, at, at, size, at, at, ctypes.c_double, integer, integer, at]
        self._apply.restype = None
        self._spaces, self._lock = torch.empty(0, dtype=torch.float64), Lock()

    def filtered(self, rows: Tensor, centre: float = 0.0, times: int = 1) -> Tensor:
        if rows.ndim != 2 or rows.shape[1] != self._n or rows.dtype != torch.float64 or rows.device.type != "cpu":
            given = f"{tuple(rows.shape)}, {rows.dtype} on {rows.device}"
            raise ValueError(f"rows: {given} given, expected (m, {self._n}), torch.float64 on cpu")
        rows, m = rows.resolve_neg().contiguous(), rows.shape[0]
        threads = max(1, min(torch.get_num_threads(), -(-m // self._width)))
        found = torch.empty_like(rows)
        factor = [array.ctypes.data for array in self._lower]
        where = (rows.data_ptr(), found.data_ptr())
        with self._lock:  # of the space that its calls share: memory that is new each time takes longer than the sweeps
            if self._spaces.numel() < threads * 2 * self._width * self._n:
                self._spaces = torch.empty(threads * 2 * self._width * self._n, dtype=torch.float64)
            self._apply(self._n, *factor, m, *where, centre, times, threads, self._spaces.data_ptr())
        return found


class _Cholespy(Factor):
    def __init__(self, matrix: "scipy.sparse.csc_array", device: torch.device) -> None:
        import cholespy

        entries = (matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data)
        try:
            # It factors, and solves, where these are. Of a CSC matrix it would hand the memory, which is NumPy's, to
            # realloc (seen: aborted processes); of a CSR one, here the same, it makes its own.
            there = [torch.from_numpy(values).to(device) for values in entries]
            self._factor = cholespy.CholeskySolverD(matrix.shape[0], *there, cholespy.MatrixType.CSR)
        except (RuntimeError, ValueError) as error:
            raise FactorError(f"no Cholesky factor: {error}") from error
        self._columns = _COLUMNS[device.type]

    def filtered(self, rows: Tensor, centre: float = 0.0, times: int = 1) -> Tensor:
        for _ in range(times):
            result = torch.empty_like(rows)
            for begin in range(0, rows.shape[0], self._columns):
                given = rows[begin : begin + self._columns].T.contiguous()
                found = torch.empty_like(given)
                self._factor.solve(given, found)
                result[begin : begin + self._columns] = found.T
            rows = result.sub_(rows, alpha=centre)
        return rows
