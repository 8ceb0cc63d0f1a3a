"""Nearest vertices of a surface in two stages: among anchor vertices first, then around the best anchor."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchqm.fmap.nearest import nearest_rows, require_finite_coordinates, rounding_bound, settled
from torchqm.fmap.threads import in_parallel, shares, workers

__all__ = ["SurfaceSearch"]

_GROUPS = 16  # anchors of a block in the second stage


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
        around = _closest_in_space(everything, chosen, min(m, len(everything)))
        close = _closest_in_space(chosen, everything, min(n, len(chosen)))
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
            ValueError: the guide is of a surface with another number of vertices, or a coordinate is NaN, infinite or
                too large for single precision.
        """
        require_finite_coordinates(queries, points)
        given, everything = queries.detach().numpy(), points.detach().numpy()
        chosen = everything[self.anchors.numpy()]
        # What all coordinates have in common is taken off before it costs digits in single precision.
        centre = chosen[:64].mean(0)
        queries32, points32 = _float32(given, centre), _float32(everything, centre)
        anchor_points = points32[self.anchors.numpy()]
        if guide is None:
            stage = nearest_rows(torch.from_numpy(queries32), torch.from_numpy(anchor_points), exact=False).numpy()
        else:
            if guide.close.shape[0] != len(queries32):
                raise ValueError(f"guide: has {guide.close.shape[0]} vertices, but there are {len(queries32)} queries")
            at_anchors = torch.from_numpy(queries32[guide.anchors.numpy()])
            nearest = nearest_rows(at_anchors, torch.from_numpy(anchor_points), exact=False)
            partners = nearest.numpy()[guide.close.numpy()]
            some = shares(len(partners))
            tasks = [partial(_closest, queries32[rows], anchor_points, partners[rows]) for rows in some]
            stage = partners[np.arange(len(partners)), np.concatenate(in_parallel(tasks))]
        found, rows, columns = _around(queries32, points32, stage, self.around.numpy())
        if len(rows):  # few, and doubtful
            unsure, place = np.unique(rows, return_inverse=True)
            found[unsure] = settled(given[unsure], everything, place, columns)
        return torch.from_numpy(found)


def _closest_in_space(points: np.ndarray, queries: np.ndarray, k: int) -> np.ndarray:
    """``(Q, k)`` the nearest points of each query; a k-d tree gives them without the last dimension for k = 1."""
    tree, parts = scipy.spatial.cKDTree(points), [queries[rows] for rows in shares(len(queries))]
    found = in_parallel([partial(tree.query, part, k, workers=torch.get_num_threads()) for part in parts])
    return np.concatenate([ids for _, ids in found])


def _around(
    queries: Shaped[np.ndarray, "Q K"],
    points: Shaped[np.ndarray, "V K"],
    stage: Shaped[np.ndarray, " Q"],
    around: Shaped[np.ndarray, "A m"],
) -> tuple[Int[np.ndarray, " Q"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """The nearest point around the anchor of each query in single precision, and all candidates where it cannot tell.

    Returns:
        ``(Q,)`` points, ``(N,)`` doubtful queries and for each of these a candidate; each doubtful one has all of its
        candidates there.
    """
    with np.errstate(over="ignore"):
        half = np.einsum("vk,vk->v", points, points) / 2
    if not np.isfinite(half.sum()):
        raise ValueError("points: coordinates are too large for single precision; scale the shapes to area 1")
    norms, reach, d = np.sqrt(np.einsum("qk,qk->q", queries, queries)), np.sqrt(2 * half), points.shape[1]
    order = np.argsort(stage, kind="stable")
    anchors, starts, counts = np.unique(stage[order], return_index=True, return_counts=True)
    by_size = np.argsort(counts, kind="stable")  # anchors with about as many queries make one product
    found = np.zeros(len(queries), dtype=np.int64)

    def search(groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        near = around[anchors[groups]]
        most = int(counts[groups].max())
        # The last query of a smaller group is repeated.
        places = starts[groups, None] + np.minimum(np.arange(most), counts[groups, None] - 1)
        mine = order[places]
        products = queries[mine] @ points[near].transpose(0, 2, 1) - half[near][:, None]
        where = products.argmax(2)[:, :, None]
        best = np.take_along_axis(products, where, 2)[:, :, 0]
        found[mine] = np.take_along_axis(near, where[:, :, 0], 1)
        np.put_along_axis(products, where, -np.inf, 2)
        enough = best - 2 * rounding_bound(norms[mine], reach[near].max(1)[:, None], d)
        doubtful = products.max(2) >= enough
        doubtful &= np.arange(most) < counts[groups, None]  # once, not as often as it is repeated
        group, query = np.nonzero(doubtful)
        one, place = np.nonzero(products[group, query] >= enough[group, query, None])
        rows, ids = mine[group, query], near[group]
        return np.concatenate([rows, rows[one]]), np.concatenate([found[rows], ids[one, place]])

    def search_all(some: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
        return [search(groups) for groups in some]

    blocks = [by_size[i : i + _GROUPS] for i in range(0, len(by_size), _GROUPS)]
    n = workers()
    pairs = [pair for part in in_parallel([partial(search_all, blocks[i::n]) for i in range(n)]) for pair in part]
    none = np.zeros(0, dtype=np.int64)
    rows, columns = (np.concatenate([none, *(pair[i] for pair in pairs)]) for i in (0, 1))
    return found, rows, columns


def _closest(queries: np.ndarray, points: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """For each query which of its few candidates is nearest."""
    half = (points**2).sum(1) / 2
    values = np.empty(candidates.shape, dtype=points.dtype)
    for column, ids in enumerate(candidates.T):
        values[:, column] = np.einsum("qk,qk->q", queries, points[ids]) - half[ids]
    return values.argmax(1)


def _float32(values: np.ndarray, centre: np.ndarray) -> np.ndarray:
    out = np.empty(values.shape, dtype=np.float32)
    some = shares(len(values))
    in_parallel([partial(np.subtract, values[rows], centre, out=out[rows], casting="same_kind") for rows in some])
    return out
