"""From a known reflection to left and right: displacement function, persistence clustering (paper, section 6.1)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.geodesic import EdgePoints, distance_to_curve, nodal_crossings
from torchqm.geometry.mesh import Mesh

__all__ = ["LeftRight", "displacement", "halves_of_reflection", "persistence_clusters"]


@dataclass(frozen=True, eq=False)
class LeftRight:
    """Two parts of a shape found by persistence-based clustering, with the numbers that tell whether to trust them.

    Args:
        sign: ``(V,)`` -1 on one part, +1 on the other, 0 on vertices without area: the left-right map epsilon. Which
            part is called left is arbitrary.
        persistence: persistences of the finite peaks, largest first (at most ten); the first is the second part's.
        top: value of the highest peak, whose persistence is infinite.
        balance: area of the smaller part / area of the larger one; 1 for a true reflection.
    """

    sign: Float[Tensor, " V"]
    persistence: tuple[float, ...]
    top: float
    balance: float

    @property
    def margin(self) -> float:
        """Second peak's persistence over the third's: how clearly the diagram says "two"; infinite without a third."""
        if len(self.persistence) < 2:
            return float("inf") if self.persistence else 0.0
        return self.persistence[0] / max(self.persistence[1], 1e-300)

    @property
    def warning(self) -> str | None:
        """What is doubtful about the two parts, with the numbers; None if nothing is."""
        if not self.persistence:
            return "persistence clustering found one peak only: the shape was not cut into left and right"
        doubts = []
        if self.margin < 1.5:
            doubts.append(
                f"no clear second peak (persistences {', '.join(f'{p:.3g}' for p in self.persistence[:4])}; "
                f"second / third = {self.margin:.2f}, clear is 1.5 or more)"
            )
        if self.balance < 0.8:
            doubts.append(f"the two parts differ in area (smaller / larger = {self.balance:.2f}, 1 is expected)")
        return "left-right clustering: " + "; ".join(doubts) if doubts else None


def displacement(
    mesh: Mesh,
    reflection: Int[Tensor, " V"],
    kind: str = "intrinsic",
    side: Float[Tensor, " V"] | None = None,
) -> Float[Tensor, " V"]:
    """``phi(x) = d(x, S(x))``: how far a reflection moves each point.

    ``extrinsic`` is the length of the straight segment. ``intrinsic`` is the geodesic distance. Any path from x to S(x)
    crosses the axis of a reflection that separates left from right, and the two pieces can be mirrored into each other,
    so ``d(x, S(x)) = 2 d(x, axis)`` exactly, and one run of the geodesic solver gives it at all vertices. The axis is
    where ``side`` changes sign; without ``side`` it is read off the map: vertices that stay, and midpoints of edges
    whose ends are exchanged.

    Args:
        mesh: the shape.
        reflection: ``(V,)`` vertex map of the reflection S.
        kind: ``intrinsic`` or ``extrinsic``.
        side: a function of opposite signs left and right, e.g. the signed distance from the mirror plane.

    Returns:
        ``(V,)`` distances in units of the mesh; 0 on vertices without area.

    Raises:
        ValueError: unknown kind; or, for ``intrinsic``, no axis was found.

    References:
        Paper, section 6.1, step 1.
    """
    if kind == "extrinsic":
        return (mesh.verts - mesh.verts[reflection]).norm(dim=1)
    if kind != "intrinsic":
        raise ValueError(f"kind={kind!r}: allowed are 'intrinsic' and 'extrinsic'")
    axis = _axis_of_map(mesh, reflection) if side is None else nodal_crossings(mesh, side)
    if axis.edges.shape[0] == 0:
        raise ValueError(
            f"{mesh.label}: the symmetry map has no axis (no vertex stays, no edge is turned over), "
            "so it is no reflection with a fixed curve; use kind='extrinsic'"
        )
    distance = 2 * distance_to_curve(mesh, axis)
    return torch.where(torch.isfinite(distance) & mesh.referenced, distance, 0.0)


def _axis_of_map(mesh: Mesh, reflection: Tensor) -> EdgePoints:
    """Fixed vertices and midpoints of edges that the map turns over, as points on edges."""
    i, j = mesh.edges.T
    stays = reflection == torch.arange(mesh.n_verts)
    turned = (reflection[i] == j) & (reflection[j] == i)
    edges = torch.cat([mesh.edges[stays[i]], mesh.edges[stays[j]].flip(1), mesh.edges[turned]])
    t = torch.zeros(edges.shape[0], dtype=torch.float64)
    t[edges.shape[0] - int(turned.sum()) :] = 0.5
    return EdgePoints(edges, t)


def halves_of_reflection(mesh: Mesh, reflection: Int[Tensor, " V"], side: Float[Tensor, " V"]) -> Float[Tensor, " V"]:
    """The left-right map of a shape whose reflection is known: the sign of ``side(x) - side(S(x))``.

    Args:
        mesh: the shape.
        reflection: its vertex map S.
        side: any function that tells left from right, e.g. signed distance from the mirror plane.

    Returns:
        ``(V,)`` -1, +1, and 0 on the axis.
    """
    return torch.sign(side - side[reflection])


def persistence_clusters(mesh: Mesh, height: Float[Tensor, " V"]) -> LeftRight:
    """Cut a shape into two parts by ToMATo: each vertex climbs to a peak, and peaks merge until two are left.

    The graph is the mesh itself; the persistence threshold is read off the diagram, just below the second peak.

    Args:
        mesh: the shape.
        height: ``(V,)`` the pulled-back displacement ``psi``, high in the middle of each half, low on the axis.

    Returns:
        The two parts with persistences and area balance; never refuses, see :attr:`LeftRight.warning`.

    References:
        Paper, section 6.1, step 3; Chazal, Guibas, Oudot and Skraba 2011 (ToMATo), through gudhi.
    """
    from gudhi.clustering.tomato import Tomato
    from scipy.sparse import csr_array

    used = np.flatnonzero(mesh.referenced.numpy())
    new_id = np.full(mesh.n_verts, -1)
    new_id[used] = np.arange(used.size)
    i, j = new_id[mesh.edges.numpy()].T
    both = (np.concatenate([i, j]), np.concatenate([j, i]))
    graph = csr_array((np.ones(both[0].size), both), shape=(used.size, used.size))
    neighbours = np.split(graph.indices, graph.indptr[1:-1])
    model = Tomato(graph_type="manual", density_type="manual")
    model.fit(neighbours, weights=height.numpy()[used])
    pairs = np.asarray(model.diagram_).reshape(-1, 2)
    persistence = np.sort(pairs[:, 0] - pairs[:, 1])[::-1]
    sign = torch.zeros(mesh.n_verts, dtype=torch.float64)
    balance = 0.0
    if persistence.size:
        model.n_clusters_ = 2
        labels = np.asarray(model.labels_)
        sign[torch.from_numpy(used)] = torch.from_numpy(np.where(labels == labels.max(), 1.0, -1.0))
        right = float(mesh.vertex_areas[sign > 0].sum())
        left = float(mesh.vertex_areas[sign < 0].sum())
        balance = min(left, right) / max(left, right)
    else:
        sign[torch.from_numpy(used)] = 1.0
    return LeftRight(sign, tuple(float(p) for p in persistence[:10]), float(height.max()), balance)
