"""Lowest eigenpairs of a sparse matrix by block Lanczos on a filtered inverse, with many right-hand sides at a time."""

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from torchqm.spectral.projections import for_products, project, subtract_
from torchqm.spectral.sparse_solve import FactorError, factorize

__all__ = ["BLOCK", "LanczosError", "LanczosPairs", "lowest_eigenpairs", "residual_scale"]

BLOCK = 16
"""Vectors of a block.

28k vertices, 200 pairs, one thread, seconds and vectors in the end: block 8 2.8 and 400, 16 2.4 and 480, 32 4.1 and 576
(matrix products of narrow blocks are slow, wide blocks need more vectors)."""

_SHIFT, _CUT = (
    0.15,
    1.5,
)  # of the last eigenvalue wanted: below zero, and where the filter begins to let functions through
_CHECK_FROM, _CHECK_EVERY = 1.2, 2
_GUESSES, _WIDER = 4, 2  # filters that are tried, and how often the blocks are doubled
_ZERO = 1e-9  # of the last eigenvalue wanted: the eigenvalue of a constant function is below it


class LanczosError(RuntimeError):
    """The eigenpairs were not found; the message says what was seen."""


@dataclass(frozen=True, eq=False)
class LanczosPairs:
    """What :func:`lowest_eigenpairs` found.

    Args:
        evals: ``(k,)`` ascending.
        evecs: ``(k, n)`` orthonormal rows.
        residuals: ``(k,)`` ``|| A x - lambda x || / scale``.
        scale: ``(k,)`` the eigenvalues; for those of zero the first that is not.
        size: vectors of the subspace in the end.
        attempts: how often the filter had to be chosen anew, and 1.
    """

    evals: np.ndarray
    evecs: Tensor
    residuals: np.ndarray
    scale: np.ndarray
    size: int
    attempts: int


def lowest_eigenpairs(
    matrix: "scipy.sparse.csc_array", k: int, tol: float, guess: float, block: int = BLOCK, device: str = "cpu"
) -> LanczosPairs:
    """The ``k`` lowest eigenpairs of a sparse symmetric positive semidefinite matrix.

    Lanczos finds first what lies far out in the spectrum of its operator. For the inverse alone these are few of the
    functions wanted: their ``1 / lambda`` crowds where the unwanted ones are. So the operator is
    ``(B - a)^2`` with ``B = (A + s)^-1``, ``s`` about a seventh of the last eigenvalue wanted ``lambda_k``, and ``a``
    half of ``B``'s value at ``1.5 lambda_k``: all beyond that is folded into ``[0, a^2]``, all below spread out evenly.
    In the end each vector gets one more solve, which takes what is left of high frequencies out of it, and the matrix
    is diagonalised on the result.

    Args:
        matrix: ``(n, n)`` sparse, symmetric.
        k: number of pairs, well below ``n``.
        tol: ``|| A x - lambda x || <= tol lambda`` is wanted (as far as rounding of ``A x`` allows).
        guess: about ``lambda_k``; a wrong one costs time. If it was too low that is seen, and another is taken.
        block: vectors of a block. Of an eigenvalue as many copies are found as a block has vectors: where there may be
            more, the block is doubled.
        device: ``cpu`` or ``cuda``: where the long vectors live, their products are made and the systems are solved.
            What is returned is on the CPU.

    Raises:
        LanczosError: no factorisation, no convergence, too few rows, or more equal eigenvalues than a block can hold
            that was made four times as wide.
        ValueError: ``k``, ``tol``, ``guess`` or ``block`` that make no sense, or entries that are not finite.

    References:
        G. Golub, R. Underwood, "The block Lanczos method for computing eigenvalues", 1977; filters in the manner of
        Y. Zhou et al., "Self-consistent-field calculations using Chebyshev-filtered subspace iteration", 2006.
    """
    for name, value in (("k", k), ("tol", tol), ("guess", guess), ("block", block)):
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}: {value} given, expected a positive number")
    if not np.isfinite(matrix.data).all():
        raise ValueError("matrix: has entries that are NaN or infinite")
    # Zero comes as often as there are components.
    components = int(scipy.sparse.csgraph.connected_components(matrix, directed=False)[0])
    block *= -(-(components + 1) // block)
    inner, guesses, wider, attempts = tol / 4, _GUESSES, _WIDER, 0
    while True:
        attempts += 1
        seen = _attempt(matrix, k, inner, guess, block, attempts, torch.device(device))
        if seen.pairs is None:
            text = f"{seen.done} of {k} pairs within {tol:g} from {seen.size} vectors, filter at {guess:.4g}"
            guess, guesses = seen.guess, guesses - 1
        elif (widest := _widest_cluster(seen.pairs.evals, min(10 * tol, 1e-6), guess)) >= block:
            text = f"{widest} equal eigenvalues in blocks of {block}"
            block, wider = 2 * block, wider - 1
        elif (text := _excess(matrix, seen.pairs, tol)) == "":
            return seen.pairs
        else:  # a cluster of pairs that were all just within the bound
            inner, guesses = inner / 10, guesses - 1
        if guesses == 0 or wider < 0:
            raise LanczosError(f"block Lanczos: {text}")


def residual_scale(evals: np.ndarray, otherwise: float) -> np.ndarray:
    """What residuals are relative to: the eigenvalue; for those of constants the first other one, if there is one.

    Example:
        >>> residual_scale(np.array([0.0, 2.0, 8.0]), 1.0)
        array([2., 2., 8.])
    """
    above = evals[evals > _ZERO * max(evals[-1], otherwise)]
    return np.maximum(evals, above[0] if above.size else otherwise)


@dataclass(frozen=True)
class _Seen:
    """What one filter and one width of blocks gave: the pairs, or a better guess."""

    pairs: LanczosPairs | None
    guess: float
    done: int
    size: int


def _attempt(
    matrix: "scipy.sparse.csc_array", k: int, tol: float, guess: float, block: int, number: int, device: torch.device
) -> _Seen:
    """One run; nothing of it stays in memory but what is returned."""
    with threadpool_limits(1, "blas"):  # of NumPy's small matrices; the long products are torch's
        run = _Run(matrix, k, tol, guess, block, device)
        try:
            pairs = run.pairs(number) if run.iterate() else None
        except np.linalg.LinAlgError as error:
            raise LanczosError(f"block Lanczos: {error}") from error
    return _Seen(pairs, run.better_guess(), run.done, run.size)


def _excess(matrix: "scipy.sparse.csc_array", pairs: LanczosPairs, tol: float) -> str:
    """Which residual is larger than it may be, in words; nothing if none is."""
    # The product A x alone is wrong by eps |A|; the lowest eigenvalues feel it most.
    rounding = 10 * np.finfo(np.float64).eps * abs(matrix).sum(0).max() / pairs.scale
    worst = int(np.argmax(pairs.residuals / np.maximum(tol, rounding)))
    if pairs.residuals[worst] <= max(tol, float(rounding[worst])):
        return ""
    return f"pair {worst} of {len(pairs.residuals)} has a residual of {pairs.residuals[worst]:.2g}, not {tol:g}"


class _Run:
    """One Lanczos run with one filter; rows of ``vectors`` are orthonormal.

    Long vectors are on the device, in the order of the factor.
    """

    def __init__(
        self, matrix: "scipy.sparse.csc_array", k: int, tol: float, guess: float, block: int, device: torch.device
    ) -> None:
        n = matrix.shape[0]
        self.device = device
        self.matrix, self.k, self.tol, self.guess, self.block = matrix, k, tol, guess, block
        self.shift = _SHIFT * guess
        try:
            self.factor = factorize(matrix, self.shift, device)
        except FactorError as error:
            raise LanczosError(f"block Lanczos: {error}") from error
        self.centre = 0.5 / (_CUT * guess + self.shift)
        self.limit = min(4 * k + 30 * block, n - block)
        if self.limit < k + block:
            raise LanczosError(f"block Lanczos: {n} rows are too few for {k} pairs in blocks of {block}")
        # Memory is taken as it is written.
        self.vectors = for_products(torch.empty(self.limit, n, dtype=torch.float64, device=device))
        self.projected = np.zeros((self.limit, self.limit))
        self.random = np.random.default_rng(0)
        self.size, self.done = 0, 0
        self.theta, self.ritz = np.zeros(0), np.zeros((0, 0))

    def iterate(self) -> bool:
        """Add blocks until the pairs have converged; False if there is no room for more."""
        new, _, _ = self._orthonormal(self.factor.filtered(self._random_rows(self.block), self.centre, 2))
        steps = 0
        while True:
            begin, self.size = self.size, self.size + self.block
            self.vectors[begin : self.size] = new
            new, along, rest = self._orthonormal(self.factor.filtered(new, self.centre, 2))
            self.projected[: self.size, begin : self.size] = along
            self.projected[begin : self.size, : self.size] = along.T
            steps += 1
            full = self.size + self.block > self.limit
            if full or (self.size >= _CHECK_FROM * self.k and steps % _CHECK_EVERY == 0):
                if self._converged(rest, begin):
                    return True
                # The filter began below the last eigenvalue wanted: more vectors will not help.
                if full or (self.size >= 2 * self.k + 4 * self.block and self._open() < self.k):
                    return False

    def better_guess(self) -> float:
        """The ``k``-th eigenvalue as seen by the filter; a larger one where the filter lets less than ``k`` through."""
        if self.theta.size == self.k and self.theta[-1] > self.centre**2:
            return float(1 / (self.centre + np.sqrt(self.theta[-1])) - self.shift)
        return self.guess * float(np.clip(1.5 * self.k / max(self._open(), 1), 2, 16))

    def _open(self) -> int:
        """How many of the pairs wanted the filter lets through."""
        return int((self.theta > self.centre**2).sum())

    def pairs(self, attempts: int) -> LanczosPairs:
        """Ritz vectors, one more solve of each, and the matrix diagonalised on what comes out."""
        start = self._there(self.ritz.T.copy()) @ self.vectors[: self.size]
        self.vectors = start  # the long list is not needed any more
        solved = self.factor.filtered(start)
        gram, form = _here(solved @ solved.T), _here(solved @ start.T)  # (A + s) solved = start
        shifted, turn = scipy.linalg.eigh((form + form.T) / 2, (gram + gram.T) / 2)
        evecs = self._in_order((self._there(turn.T.copy()) @ solved).cpu())
        evals = shifted - self.shift
        applied = (self.matrix @ evecs.numpy().T).T - evals[:, None] * evecs.numpy()
        scale = residual_scale(evals, self.guess)
        return LanczosPairs(evals, evecs, np.linalg.norm(applied, axis=1) / scale, scale, self.size, attempts)

    def _converged(self, rest: np.ndarray, begin: int) -> bool:
        theta, ritz = np.linalg.eigh(self.projected[: self.size, : self.size])
        self.theta, self.ritz = theta[::-1][: self.k], ritz[:, ::-1][:, : self.k]
        self.done = int((self._bounds(rest @ self.ritz[begin:]) <= self.tol).sum())
        return self.done == self.k

    def _bounds(self, rest: np.ndarray) -> np.ndarray:
        """Bounds of the residuals that :meth:`pairs` will have; infinite where the filter lets nothing through.

        With ``r = ((B - a)^2 - theta) x`` and ``nu = a + sqrt(theta)``, ``(B - nu) x = (B - a + sqrt(theta))^-1 r``,
        where no eigenvalue of the bracket is below ``sqrt(theta) - a``. One more solve, ``x' = B x / nu``, makes of it
        ``A x' - lambda x' = -nu^-2 (B - nu) x``.
        """
        root = np.sqrt(np.maximum(self.theta, 0))
        open_, shifted = root > self.centre, 1 / (self.centre + root)
        evals = shifted - self.shift
        scale = residual_scale(evals, self.guess)
        gap = np.where(open_, root - self.centre, 1.0)
        bounds = np.linalg.norm(rest, axis=0) * shifted**2 / (gap * scale)
        return np.where(open_, bounds, np.inf)

    def _random_rows(self, count: int) -> Tensor:
        return self._there(self.random.standard_normal((count, self.matrix.shape[0])))

    def _in_order(self, rows: Tensor) -> Tensor:
        """Columns as in the matrix."""
        if self.factor.order is None:
            return rows
        sorted_ = torch.empty_like(rows)
        sorted_[:, torch.from_numpy(self.factor.order)] = rows
        return sorted_

    def _there(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).to(self.device)

    def _orthonormal(self, rows: Tensor) -> tuple[Tensor, np.ndarray, np.ndarray]:
        """``rows = along^T vectors + rest^T new`` with ``new`` orthonormal and orthogonal to all vectors so far.

        All but the last two blocks are met by rounding alone, so a first pass over those two and a second one over all
        leave nothing of them (twice is enough).
        """
        along, rest = np.zeros((self.size, rows.shape[0])), np.eye(rows.shape[0])
        for begin in (max(self.size - 2 * self.block, 0), 0):
            if self.size:
                part = project(self.vectors[begin : self.size], rows)
                subtract_(rows, self.vectors[begin : self.size], part)
                along[begin:] += _here(part) @ rest
            rows, turn = self._whitened(rows)
            rest = turn @ rest
        return rows, along, rest

    def _whitened(self, rows: Tensor) -> tuple[Tensor, np.ndarray]:
        """Orthonormal rows ``Q`` and ``turn`` with ``rows = turn^T Q``; where rows depend on each other, new ones."""
        gram = _here(rows @ rows.T)
        evals, evecs = np.linalg.eigh((gram + gram.T) / 2)
        good = evals > 1e-14 * max(evals[-1], np.finfo(float).tiny)
        turn = (evecs * np.where(good, np.sqrt(np.maximum(evals, 0)), 0)).T
        inverse = (evecs * np.where(good, 1 / np.sqrt(np.where(good, evals, 1)), 0)).T
        basis = self._there(inverse) @ rows
        if not good.all():
            basis = self._filled(basis, np.flatnonzero(~good))
        return basis, turn

    def _filled(self, basis: Tensor, empty: np.ndarray) -> Tensor:
        fresh = self._random_rows(len(empty))
        kept = basis[np.setdiff1d(np.arange(len(basis)), empty)]
        for _ in range(3):
            for known in (self.vectors[: self.size], kept):
                fresh = fresh - (fresh @ known.T) @ known
            fresh = torch.linalg.qr(fresh.T).Q.T
        basis[empty] = fresh
        return basis


def _here(values: Tensor) -> np.ndarray:
    return values.cpu().numpy()


def _widest_cluster(evals: np.ndarray, rtol: float, guess: float) -> int:
    """Most eigenvalues in a row of which neighbours differ by less than ``rtol``, those of constants by rounding."""
    gaps = np.diff(evals) > np.maximum(rtol * evals[1:], _ZERO * guess)
    ends = np.flatnonzero(np.concatenate([[True], gaps, [True]]))
    return int(np.diff(ends).max())
