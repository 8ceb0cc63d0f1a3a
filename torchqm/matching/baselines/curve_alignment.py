"""Closed curves on a surface: the axis of a reflection, points along it in order, and the alignment of two of them."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.geodesic import EdgePoints, nodal_crossings
from torchqm.geometry.mesh import Mesh

__all__ = ["Alignment", "SurfaceCurve", "align_closed", "axis_curve"]


class SurfaceCurve(NamedTuple):
    """Points along a closed curve, at equal distances, the first not repeated.

    Args:
        points: where they are: on edges of the mesh.
        length: of the curve, in the unit of the mesh.
        share: its length as a share of all pieces of the axis.
        closed: False if it was an open piece (a mesh with boundary), whose ends were joined.
    """

    points: EdgePoints
    length: float
    share: float
    closed: bool

    @property
    def vertices(self) -> Int[Tensor, " N"]:
        """The end of its edge that each point is nearer to."""
        return torch.where(self.points.t < 0.5, self.points.edges[:, 0], self.points.edges[:, 1])

    def values(self, f: Float[Tensor, "V C"]) -> Float[Tensor, "N C"]:
        """A function at the points, linear along edges."""
        t = self.points.t[:, None]
        return (1 - t) * f[self.points.edges[:, 0]] + t * f[self.points.edges[:, 1]]


def axis_curve(mesh: Mesh, side: Float[Tensor, " V"], n: int = 128) -> SurfaceCurve:
    """The longest curve along which a function changes sign, as n points in order.

    Args:
        mesh: the shape.
        side: negative on one side of the axis, positive on the other.
        n: points.

    Raises:
        ValueError: fewer than 3 points, or the function does not change sign.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> body = creature("ellipsoid", 500).mesh.normalized()
        >>> curve = axis_curve(body, body.verts[:, 0], n=40)
        >>> curve.closed, bool(body.verts[curve.vertices, 0].abs().max() < 0.1)
        (True, True)
    """
    if n < 3:
        raise ValueError(f"n={n}: a closed curve needs at least 3 points")
    crossings = nodal_crossings(mesh, side)
    if not len(crossings.t):
        raise ValueError(f"side: does not change sign on {mesh.label}, so it has no axis")
    ends, t = mesh.verts[crossings.edges], crossings.t[:, None]
    places = ((1 - t) * ends[:, 0] + t * ends[:, 1]).numpy()
    pieces = _trace(mesh, crossings.edges.numpy())
    lengths = [float(np.linalg.norm(np.diff(places[ids], axis=0), axis=1).sum()) for ids, _ in pieces]
    longest = int(np.argmax(lengths))
    ids, closed = pieces[longest]
    if not closed:
        ids = np.append(ids, ids[0])
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(places[ids], axis=0), axis=1).cumsum()])
    # Of the two crossings around each wanted place the nearer one: the steps between them are far below the spacing.
    wanted = along[-1] * np.arange(n) / n
    after = np.searchsorted(along, wanted).clip(1, len(along) - 1)
    chosen = ids[np.where(wanted - along[after - 1] < along[after] - wanted, after - 1, after)]
    points = EdgePoints(crossings.edges[chosen], crossings.t[chosen])
    return SurfaceCurve(points, float(along[-1]), lengths[longest] / max(sum(lengths), 1e-300), closed)


def _trace(mesh: Mesh, edges: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Crossed edges in order, piece by piece: a triangle joins the two of its edges that are crossed.

    Closed pieces end with the edge that they begin with.
    """
    n = mesh.n_verts
    keys = edges.min(1) * n + edges.max(1)
    order = np.argsort(keys)
    sides = mesh.faces.numpy()[:, [[0, 1], [1, 2], [2, 0]]]
    side_keys = sides.min(2) * n + sides.max(2)
    place = np.searchsorted(keys[order], side_keys).clip(max=len(keys) - 1)
    number = np.where(keys[order][place] == side_keys, order[place], -1)
    crossed = number[(number >= 0).sum(1) == 2]
    links: list[list[int]] = [[] for _ in range(len(edges))]
    for a, b in np.sort(crossed, axis=1)[:, 1:].tolist():
        links[a].append(b)
        links[b].append(a)
    seen = np.zeros(len(edges), dtype=bool)
    pieces = []
    # Ends of open pieces first, so that these are walked from end to end.
    for start in sorted(range(len(edges)), key=lambda i: len(links[i])):
        if seen[start]:
            continue
        walk, here = [start], start
        seen[start] = True
        while True:
            onward = [b for b in links[here] if not seen[b]]
            if not onward:
                break
            here = onward[0]
            seen[here] = True
            walk.append(here)
        closed = len(walk) > 2 and start in links[here]
        pieces.append((np.array([*walk, start] if closed else walk), closed))
    return pieces


class Alignment(NamedTuple):
    """Which point of one closed curve belongs to each point of another.

    Args:
        partners: ``(N,)`` for each point of the first curve a point of the second.
        forward: whether the second is run through in its own direction.
        cost: mean cost of a step.
    """

    partners: Int[Tensor, " N"]
    forward: bool
    cost: float


def align_closed(
    features_x: Float[Tensor, "N C"], features_y: Float[Tensor, "M C"], stretch: float = 0.1
) -> list[Alignment]:
    """The best monotone alignment of two closed curves in each of the two directions, the better first.

    Dynamic programming over steps (1, 1), (1, 2) and (2, 1) in both curves, for every point of the second that the
    first may begin at. A step costs the distance of the features at its end, times the points it covers; one that
    stretches costs ``stretch`` times the mean distance more.

    Args:
        features_x: of the points of the first curve, in order.
        features_y: of those of the second.
        stretch: penalty.

    Raises:
        ValueError: a curve with fewer than 3 points, or more than twice as many on one as on the other.

    Example:
        >>> x = torch.tensor([[0.0], [5.0], [1.0], [2.0]])
        >>> best = align_closed(x, x.roll(1, 0).flip(0))[0]
        >>> best.partners.tolist(), best.forward
        ([2, 1, 0, 3], False)
    """
    n, m = len(features_x), len(features_y)
    if min(n, m) < 3 or max(n, m) > 2 * min(n, m):
        raise ValueError(f"features: {n} and {m} points; 3 or more are needed, and at most twice as many on one curve")
    distance = torch.cdist(features_x, features_y).numpy().astype(np.float64)
    found = []
    for forward in (True, False):
        # starts[o, j]: the point of the second curve that is j steps after its o-th one.
        steps = np.arange(m + 1) if forward else -np.arange(m + 1)
        reached = (np.arange(m)[:, None] + steps) % m
        found.append(_align(distance, reached, forward, stretch * float(distance.mean())))
    return sorted(found, key=lambda a: a.cost)


def _align(distance: np.ndarray, reached: np.ndarray, forward: bool, penalty: float) -> Alignment:
    n, (starts, width) = len(distance), reached.shape
    total = np.full((n + 1, starts, width), np.inf)
    came = np.zeros((n + 1, starts, width), dtype=np.int8)
    total[0, :, 0] = 0.0
    for i in range(1, n + 1):
        here = distance[i % n][reached]
        options = np.full((3, starts, width), np.inf)
        options[0, :, 1:] = total[i - 1, :, :-1] + here[:, 1:]
        options[1, :, 2:] = total[i - 1, :, :-2] + 1.5 * here[:, 2:] + penalty
        if i > 1:
            options[2, :, 1:] = total[i - 2, :, :-1] + 1.5 * here[:, 1:] + penalty
        came[i], total[i] = options.argmin(0), options.min(0)
    start = int(total[n, :, -1].argmin())
    partners = np.zeros(n, dtype=np.int64)
    i, j = n, width - 1
    while i > 0:
        partners[i % n] = reached[start, j]
        how = came[i, start, j]
        if how == 2:  # the point between the two ends belongs to the earlier of their partners
            partners[i - 1] = reached[start, j - 1] if i > 1 else partners[0]
        i, j = (i - 2, j - 1) if how == 2 else (i - 1, j - (2 if how == 1 else 1))
    return Alignment(torch.from_numpy(partners), forward, float(total[n, start, -1]) / n)
