"""Nearest neighbours between two sets of spectral coordinates, in bounded memory: float32 products, float64 answers."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchqm.fmap.threads import in_parallel, workers

__all__ = ["nearest_rows", "require_finite_coordinates", "rounding_bound", "settled"]

_ROWS, _COLUMNS = 256, 8192  # of a block of products: 8 MiB for each worker, whatever the number of points
_MANY = 256  # candidates for each query of a block from which on all its distances are computed
_PAIRS = 4096  # distances computed at a time
_LARGE = 2.0**60  # squares between 1 / _LARGE and _LARGE keep their digits in single precision


def nearest_rows(queries: Float[Tensor, "Q D"], points: Float[Tensor, "P D"], exact: bool = True) -> Int[Tensor, " Q"]:
    """For each query the index of the nearest point: ``argmin_p || q - p ||``, of equally near ones the first.

    Products in float32, in blocks (the Q x P matrix never exists), leave the points that the rounding of these products
    (:func:`rounding_bound`) does not rule out: mostly one. Where there are more, ``sum (q - p)^2`` in float64 decides.
    So the answer is that of all distances in float64, at little more than the price of single precision.

    Args:
        queries: ``(Q, D)``.
        points: ``(P, D)``.
        exact: false: leave out the second step. Where several points are nearest to within rounding, one of them comes
            back, the same one each time; for steps of an iteration, which average over thousands of points.

    Raises:
        ValueError: the coordinates have different dimensions, there are no points, or some are not finite.

    Example:
        >>> nearest_rows(torch.tensor([[0.9], [0.5]]), torch.tensor([[0.0], [1.0], [0.0]])).tolist()
        [1, 0]
    """
    if queries.shape[1] != points.shape[1]:
        raise ValueError(f"queries have {queries.shape[1]} coordinates, points have {points.shape[1]}")
    if points.shape[0] == 0:
        raise ValueError("points: there are none to choose from")
    queries, points = (v if v.dtype in (torch.float32, torch.float64) else v.double() for v in (queries, points))
    require_finite_coordinates(queries, points)
    return torch.from_numpy(_blocked(queries.detach().numpy(), points.detach().numpy(), exact=exact))


def require_finite_coordinates(queries: Float[Tensor, "Q D"], points: Float[Tensor, "P D"]) -> None:
    """ValueError where a coordinate is NaN or infinite: both survive a sum, which otherwise is seldom too large."""
    for values in (queries, points):
        if not bool(torch.isfinite(values.sum())) and not bool(torch.isfinite(values).all()):
            raise ValueError("queries and points must be finite; a spectral coordinate is NaN or infinite")


def rounding_bound(queries: np.ndarray, points: np.ndarray, d: int) -> np.ndarray:
    """How far ``q . p - || p ||^2 / 2`` in float32 may be from the truth, whatever the order of its sum.

    ``c |p| (|q| + |p|) + 2^-52 (d + 3) (|q| + |p|)^2`` with ``c = 1.1 n u / (1 - n u)``, ``u = 2^-24``, ``n = d + 8``:
    d products and their sum, both vectors rounded to float32 first, the norm rounded like a product, two comparisons.
    The second term is the rounding of distances in float64, which the answer is compared by in the end.

    Args:
        queries: norms.
        points: norms, of a shape that fits.
        d: number of coordinates.

    References:
        N. Higham, "Accuracy and Stability of Numerical Algorithms", 2002, section 3.1.
    """
    n = (d + 8) * 2.0**-24
    both = queries + points
    tiny = (d + 2) * 2.0**-90  # of products that are below the range of float32
    return (1.1 * n / (1 - n)) * points * both + ((d + 3) * 2.0**-52) * both**2 + tiny


def settled(
    queries: Shaped[np.ndarray, "Q D"],
    points: Shaped[np.ndarray, "P D"],
    rows: Int[np.ndarray, " N"],
    columns: Int[np.ndarray, " N"],
) -> Int[np.ndarray, " Q"]:
    """For each query the nearest of its candidates by ``sum (q - p)^2`` in float64; of equally near ones the first.

    Args:
        queries: all of them.
        points: all of them.
        rows: queries, each at least once.
        columns: for each of these a candidate.
    """
    out = np.empty(len(queries), dtype=np.int64)
    out[rows] = columns
    doubtful = np.flatnonzero((np.bincount(rows, minlength=len(queries)) > 1)[rows])
    if len(doubtful):
        rows, columns = rows[doubtful], columns[doubtful]
        far = np.empty(len(rows))
        for i in range(0, len(rows), _PAIRS):
            some = slice(i, i + _PAIRS)
            apart = np.subtract(queries[rows[some]], points[columns[some]], dtype=np.float64)
            far[some] = np.einsum("nd,nd->n", apart, apart)
        order = np.lexsort((columns, far, rows))
        first = order[np.flatnonzero(np.diff(rows[order], prepend=-1))]
        out[rows[first]] = columns[first]
    return out


@dataclass(eq=False)
class _Range:
    """Some of the queries, one after the other, and their candidates so far.

    Args:
        queries: ``(n, d + 1)`` centred, in float32, with a 1 at the end.
        given: ``(n, d)`` as they came.
        norms: ``(n,)``
        low: ``(n,)`` what the largest product is at least.
        rows: of the candidates, one array a block.
        columns: likewise.
        high: what their product is at most.
    """

    queries: np.ndarray
    given: np.ndarray
    norms: np.ndarray
    low: np.ndarray
    rows: list[np.ndarray] = field(default_factory=list)
    columns: list[np.ndarray] = field(default_factory=list)
    high: list[np.ndarray] = field(default_factory=list)

    def add(self, rows: np.ndarray, columns: np.ndarray, high: np.ndarray, good: np.ndarray) -> None:
        """Candidates, where they are good."""
        for kept, new in zip((self.rows, self.columns, self.high), (rows, columns, high), strict=True):
            kept.append(new if good.all() else new[good])


def _blocked(
    queries: Shaped[np.ndarray, "Q D"],
    points: Shaped[np.ndarray, "P D"],
    rows: int = _ROWS,
    columns: int = _COLUMNS,
    exact: bool = True,
) -> Shaped[np.ndarray, " Q"]:
    """The largest ``q . p - || p ||^2 / 2`` of each query, the second term as one coordinate more of the product."""
    n, d = queries.shape
    if not n:
        return np.zeros(0, dtype=np.int64)
    # What all points have in common is taken off before it costs digits (heat kernel signatures are nearly constant).
    longer = np.ones((n, d + 1), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        centre = points[:64].mean(0)
        np.subtract(queries, centre, out=longer[:, :d], casting="same_kind")
        norms = np.einsum("qd,qd->q", longer[:, :d], longer[:, :d])
    largest, norms, starts = norms.max(), np.sqrt(norms), range(0, len(points), columns)
    best = np.full(n, -np.inf, dtype=np.float32)
    second = best.copy() if exact else best[:0]
    found, farthest = np.zeros(n, dtype=np.int64), np.zeros(1, dtype=np.float32)
    # One range of queries a worker; each range is put together from blocks that stay in the cache.
    chunk = rows * max(1, -(-n // (rows * workers())))  # the same products whatever the number of workers
    ranges = [slice(i, i + chunk) for i in range(0, n, chunk)]
    for start in starts:
        block, reach = _block(points[start : start + columns], centre)
        largest, farthest = max(largest, reach.max() ** 2), np.maximum(farthest, reach.max())
        if not largest < _LARGE:
            break
        in_parallel([partial(_improve, longer[r], block, start, rows, best[r], second[r], found[r]) for r in ranges])
    if not 1 / _LARGE < largest < _LARGE:
        return _rescaled(queries, points, centre, rows, columns)
    if not exact:
        return found
    wrong = rounding_bound(norms, farthest, d)
    # A point as near as the best one, at a distance r, is no longer than |q| + r: mostly less than the longest of all.
    square = np.maximum(norms**2 * np.float32(1.0001) - 2 * best + 2 * wrong, 0)
    wrong = rounding_bound(norms, np.minimum(farthest, (norms + np.sqrt(square)) * np.float32(1.0001)), d)
    doubtful = np.flatnonzero(second >= best - 2 * wrong)
    if len(doubtful):
        # Few, and looked at once more: that costs less than to be ready for them above.
        part = _Range(longer[doubtful], queries[doubtful], norms[doubtful], (best - wrong)[doubtful])
        for start in starts:
            if len(starts) > 1:
                block, reach = _block(points[start : start + columns], centre)
            _look(part, block, reach, points[start : start + columns], start, rows)
        found[doubtful] = _decide(part, points)
    return found


def _block(points: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(d + 1, n)`` centred points with ``- || p ||^2 / 2`` below, and their norms ``(n,)``."""
    d = points.shape[1]
    block = np.empty((d + 1, len(points)), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        np.subtract(points.T, centre[:, None], out=block[:d], casting="same_kind")
        squares = np.einsum("dp,dp->p", block[:d], block[:d])
    block[d] = squares / -2
    return block, np.sqrt(squares)


def _improve(
    queries: np.ndarray,
    block: np.ndarray,
    start: int,
    rows: int,
    best: np.ndarray,
    second: np.ndarray,
    found: np.ndarray,
) -> None:
    """Write in ``found`` the points of one block better than ``best``, and in ``second``, if it has room, the next."""
    products = np.empty((min(rows, len(queries)), block.shape[1]), dtype=np.float32)
    for i in range(0, len(queries), rows):
        part = queries[i : i + rows]
        everyone, here = np.arange(len(part)), slice(i, i + rows)
        out = np.matmul(part, block, out=products[: len(part)])
        where = out.argmax(1)
        value = out[everyone, where]
        if len(second):
            out[everyone, where] = -np.inf
            np.maximum(second[here], np.minimum(best[here], value), out=second[here])
            np.maximum(second[here], out.max(1), out=second[here])
        better = value > best[here]
        best[here][better] = value[better]
        found[here][better] = where[better] + start


def _rescaled(
    queries: np.ndarray, points: np.ndarray, centre: np.ndarray, rows: int, columns: int
) -> Shaped[np.ndarray, " Q"]:
    """The same with all coordinates multiplied by a power of two that brings the largest to 1."""
    halves = [v.astype(np.float64) / 2 for v in (queries, points)]
    largest = max(np.abs(v - centre / 2).max(initial=0) for v in halves)
    if not np.isfinite(largest):  # the mean of very large numbers
        largest = max(np.abs(v).max(initial=0) for v in halves)
    if largest == 0:  # all in one place
        return np.zeros(len(queries), dtype=np.int64)
    exponent = -int(np.frexp(largest)[1])
    queries, points = (np.ldexp(v, exponent) for v in halves)
    return _blocked(queries, points, rows, columns)


def _look(part: _Range, block: np.ndarray, reach: np.ndarray, points: np.ndarray, start: int, rows: int) -> None:
    """Add the points of one block that may be nearest to some of the queries, given what is known of the others."""
    d = block.shape[0] - 1
    products = np.empty((min(rows, len(part.queries)), block.shape[1]), dtype=np.float32)
    farthest = reach.max(keepdims=True)
    for i in range(0, len(part.queries), rows):
        queries, norms, low = (v[i : i + rows] for v in (part.queries, part.norms, part.low))
        out = np.matmul(queries, block, out=products[: len(queries)])
        wrong = rounding_bound(norms, farthest, d)
        np.maximum(low, out.max(1) - wrong, out=low)
        enough = low - wrong
        good = np.flatnonzero(out >= enough[:, None])  # twice as quick as nonzero of a matrix
        if len(good) > _MANY * len(queries):
            row = np.arange(len(queries))
            column = np.array([_first_nearest(query, points) for query in part.given[i : i + rows]])
        else:
            row, column = np.divmod(good, out.shape[1])
        value = out[row, column]
        own = rounding_bound(norms[row], reach[column], d)
        np.maximum.at(low, row, value - own)
        part.add(row + i, column + start, value + own, value + own >= low[row])


def _first_nearest(query: np.ndarray, points: np.ndarray) -> int:
    """By the same sum as in :func:`settled`, to the last bit."""
    apart = np.subtract(query, points, dtype=np.float64)
    return int(np.einsum("nd,nd->n", apart, apart).argmin())


def _decide(part: _Range, points: np.ndarray) -> Shaped[np.ndarray, " n"]:
    rows, columns, high = (np.concatenate(v) for v in (part.rows, part.columns, part.high))
    good = high >= part.low[rows]
    return settled(part.given, points, rows[good], columns[good])
