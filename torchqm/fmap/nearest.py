"""Exact nearest neighbours between two sets of spectral coordinates, in bounded memory."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchqm.fmap.threads import in_parallel, workers

__all__ = ["SurfaceSearch", "nearest_rows"]

_SMALL = 200_000  # distance entries below which one dense product is as quick as a blocked one
_GROUPS = 16  # anchors of a block in the second stage of a search on a surface
_ROWS, _COLUMNS = 256, 8192  # of a block of distances: 8 MiB for each worker, whatever the number of points


def nearest_rows(queries: Float[Tensor, "Q D"], points: Float[Tensor, "P D"]) -> Int[Tensor, " Q"]:
    """For each query the index of the nearest point: ``argmin_p || q - p ||``.

    Distances are computed in float32, in blocks: the Q x P matrix never exists. Small problems are solved in the
    precision they come in. Where several points are equally near, one of them comes back. Blocked products are as
    quick as faiss' flat index at 200 coordinates (2,000 x 5,000), and quicker at fewer.

    Raises:
        ValueError: the coordinates have different dimensions, there are no points, or some are not finite.

    Example:
        >>> nearest_rows(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]])).tolist()
        [1]
    """
    if queries.shape[1] != points.shape[1]:
        raise ValueError(f"queries have {queries.shape[1]} coordinates, points have {points.shape[1]}")
    if points.shape[0] == 0:
        raise ValueError("points: there are none to choose from")
    if not bool(torch.isfinite(queries.sum() + points.sum())):  # NaN and infinities survive a sum
        raise ValueError("queries and points must be finite; a spectral coordinate is NaN or infinite")
    if queries.shape[0] * points.shape[0] <= _SMALL:
        centre = points.mean(0)  # see _blocked
        queries, points = queries - centre, points - centre
        # || q - p ||^2 without || q ||^2, which is the same for all points
        return torch.argmax(queries @ points.T - points.square().sum(1) / 2, dim=1)
    return torch.from_numpy(_blocked(queries.detach().numpy(), points.detach().numpy()))


def _blocked(
    queries: Shaped[np.ndarray, "Q D"], points: Shaped[np.ndarray, "P D"], rows: int = _ROWS, columns: int = _COLUMNS
) -> Shaped[np.ndarray, " Q"]:
    """The largest ``q . p - || p ||^2 / 2`` of each query, the second term as one coordinate more of the product."""
    n, d = queries.shape
    # What all points have in common is taken off before it costs digits (heat kernel signatures are nearly constant).
    centre = points[:64].mean(0)
    longer = np.ones((n, d + 1), dtype=np.float32)
    np.subtract(queries, centre, out=longer[:, :d], casting="same_kind")
    best, found = np.full(n, -np.inf, dtype=np.float32), np.zeros(n, dtype=np.int64)
    for start in range(0, len(points), columns):
        part = points[start : start + columns]
        block = np.empty((d + 1, len(part)), dtype=np.float32)
        np.subtract(part.T, centre[:, None], out=block[:d], casting="same_kind")
        block[d] = np.einsum("dp,dp->p", block[:d], block[:d]) / -2
        # One range of queries a worker; each range is put together from blocks that stay in the cache.
        chunk = rows * max(1, -(-n // (rows * workers())))  # the same products whatever the number of workers
        in_parallel(
            [
                partial(_improve, longer[i : i + chunk], block, start, rows, best[i : i + chunk], found[i : i + chunk])
                for i in range(0, n, chunk)
            ]
        )
    return found


def _improve(
    queries: np.ndarray, block: np.ndarray, start: int, rows: int, best: np.ndarray, found: np.ndarray
) -> None:
    """Write in ``found`` the points of one block that are better than ``best``."""
    products = np.empty((min(rows, len(queries)), block.shape[1]), dtype=np.float32)
    for i in range(0, len(queries), rows):
        part = queries[i : i + rows]
        out = np.matmul(part, block, out=products[: len(part)])
        where = out.argmax(1)
        value = out[np.arange(len(part)), where]
        better = value > best[i : i + rows]
        best[i : i + rows][better] = value[better]
        found[i : i + rows][better] = where[better] + start


@dataclass(frozen=True, eq=False)
class SurfaceSearch:
    """Nearest vertices of a surface in two stages: among anchor vertices first, then around the best anchor.

    Spectral coordinates are smooth on the surface, so the nearest vertex lies near the nearest anchor. The second stage
    looks at the vertices closest to that in space, and nowhere else: a search among V vertices costs little more than
    one among the anchors. Queries that are themselves the vertices of a surface need not even be compared with all
    anchors: the partner of a vertex lies near those of the anchors around it. The search can miss
    (``benchmarks/speed_pair.py`` prints how often, and by how far).

    Args:
        anchors: ``(A,)`` vertex ids, spread over the surface.
        around: ``(A, m)`` for each anchor the vertices closest to it in space, itself first.
        close: ``(V, n)`` for each vertex its closest anchors in space, as indices into ``anchors``.

    Example:
        >>> line = torch.arange(10.0, dtype=torch.float64)[:, None]
        >>> search = SurfaceSearch.build(line, torch.tensor([0, 3, 6, 9]), m=3)
        >>> search.nearest(line + 0.2, line).tolist()
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]
    """

    anchors: Int[Tensor, " A"]
    around: Int[Tensor, "A m"]
    close: Int[Tensor, "V n"]

    @classmethod
    def build(cls, verts: Float[Tensor, "V D"], anchors: Int[Tensor, " A"], m: int = 96, n: int = 8) -> "SurfaceSearch":
        """Prepare the search on the vertices of a surface.

        Args:
            verts: ``(V, 3)`` positions; vertices that no face uses must be left out by the choice of ``anchors`` and
                lie nowhere near the surface, or be passed as far away.
            anchors: ids of the first stage.
            m: vertices looked at around each anchor.
            n: anchors near a vertex whose partners are tried for it.
        """
        everything, chosen = verts.numpy(), verts[anchors].numpy()
        tree, workers = scipy.spatial.cKDTree, torch.get_num_threads()
        around = tree(everything).query(chosen, k=min(m, len(everything)), workers=workers)[1]
        close = tree(chosen).query(everything, k=min(n, len(chosen)), workers=workers)[1]
        return cls(
            anchors,
            torch.from_numpy(around.reshape(len(chosen), -1)),
            torch.from_numpy(close.reshape(len(everything), -1)),
        )

    def nearest(
        self, queries: Float[Tensor, "Q K"], points: Float[Tensor, "V K"], guide: "SurfaceSearch | None" = None
    ) -> Int[Tensor, " Q"]:
        """For each query the nearest of the points around its nearest anchor.

        Args:
            queries: coordinates looked for.
            points: coordinates of all V vertices.
            guide: the search of the surface whose vertices the queries are, in their order: only the queries at its
                anchors are compared with all anchors here, the others with the partners of the anchors close to them.

        Raises:
            ValueError: the guide is of a surface with another number of vertices.
        """
        queries32, points32 = _float32(queries), _float32(points)
        anchor_points = points32[self.anchors.numpy()]
        if guide is None:
            stage = nearest_rows(torch.from_numpy(queries32), torch.from_numpy(anchor_points)).numpy()
        else:
            if guide.close.shape[0] != len(queries32):
                raise ValueError(f"guide: has {guide.close.shape[0]} vertices, but there are {len(queries32)} queries")
            at_anchors = torch.from_numpy(queries32[guide.anchors.numpy()])
            partners = nearest_rows(at_anchors, torch.from_numpy(anchor_points)).numpy()[guide.close.numpy()]
            size = max(1, -(-len(partners) // workers()))
            some = [slice(i, i + size) for i in range(0, len(partners), size)]
            tasks = [partial(_closest, queries32[rows], anchor_points, partners[rows]) for rows in some]
            stage = partners[np.arange(len(partners)), np.concatenate(in_parallel(tasks))]
        return torch.from_numpy(_around(queries32, points32, stage, self.around.numpy()))


def _around(
    queries: Shaped[np.ndarray, "Q K"],
    points: Shaped[np.ndarray, "V K"],
    stage: Shaped[np.ndarray, " Q"],
    around: Shaped[np.ndarray, "A m"],
) -> Shaped[np.ndarray, " Q"]:
    """For each query the nearest of the points around its anchor."""
    half = (points**2).sum(1) / 2
    out = np.empty(len(queries), dtype=np.int64)
    order = np.argsort(stage, kind="stable")
    anchors, starts, counts = np.unique(stage[order], return_index=True, return_counts=True)
    by_size = np.argsort(counts, kind="stable")  # anchors with about as many queries make one product

    def search(groups: np.ndarray) -> None:
        near = around[anchors[groups]]
        most = int(counts[groups].max())
        # The last query of a smaller group is repeated.
        places = starts[groups, None] + np.minimum(np.arange(most), counts[groups, None] - 1)
        mine = order[places]
        products = queries[mine] @ points[near].transpose(0, 2, 1) - half[near][:, None]
        out[mine] = np.take_along_axis(near, products.argmax(2), 1)

    def search_all(some: list[np.ndarray]) -> None:
        for groups in some:
            search(groups)

    blocks = [by_size[i : i + _GROUPS] for i in range(0, len(by_size), _GROUPS)]
    n = workers()
    in_parallel([partial(search_all, blocks[number::n]) for number in range(n)])
    return out


def _closest(queries: np.ndarray, points: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """For each query which of its few candidates is nearest."""
    half = (points**2).sum(1) / 2
    values = np.empty(candidates.shape, dtype=points.dtype)
    for column, ids in enumerate(candidates.T):
        values[:, column] = np.einsum("qk,qk->q", queries, points[ids]) - half[ids]
    return values.argmax(1)


def _float32(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().numpy(), dtype=np.float32)
