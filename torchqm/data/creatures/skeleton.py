"""Skeletons: chains of round cones that give a creature both its surface and its motion."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

__all__ = ["Chain", "Joint", "Skeleton", "reflection_group"]

_SEGMENT = 0.75  # length of the cones in radii


@dataclass(frozen=True)
class Joint:
    """A place on a chain that bends.

    Args:
        node: index of the chain's node where the bend is centred.
        width: arc length over which the rotation grows from 0 to its full angle (wide bends stretch the skin less).
    """

    node: int
    width: float


@dataclass(frozen=True, eq=False)
class Chain:
    """A smooth curve with a radius: one limb, the trunk, an ear.

    Args:
        name: unique in its skeleton.
        nodes: ``(n, 3)`` control points, root first.
        radii: ``(n,)`` radius at the nodes.
        blend: width of the smooth union with what comes before it.
        parent: the chain it hangs on (``None``: the root).
        joints: where it bends, in order of arc length.
        metric: ``(3, 3)`` matrix ``A``; the radius is measured with ``|A (x - c)|``: ``diag(1, 1, 2)`` is flat.
        orbit: chains with one orbit name are mirror images and are united in one symmetric step.
    """

    name: str
    nodes: np.ndarray
    radii: np.ndarray
    blend: float
    parent: str | None = None
    joints: tuple[Joint, ...] = ()
    metric: np.ndarray = field(default_factory=lambda: np.eye(3))
    orbit: str = ""

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = len(self.nodes)
        if n == 1:  # a ball: a segment of length nearly zero
            points = np.stack([self.nodes[0], self.nodes[0] + 1e-9 * np.array([0.0, 1.0, 0.0])])
            return points, np.repeat(self.radii, 2), np.array([0])
        chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.nodes, axis=0), axis=1))])
        if n == 2:
            return self.nodes, self.radii, np.array([0, 1])
        radius = (self.radii[1:] + self.radii[:-1]) / 2
        steps = np.clip(np.ceil(np.diff(chord) / (_SEGMENT * radius)), 2, 8).astype(int)
        spans = [np.linspace(chord[i], chord[i + 1], steps[i], endpoint=False) for i in range(n - 1)]
        u = np.concatenate([*spans, chord[-1:]])
        at_nodes = np.concatenate([[0], np.cumsum(steps)])
        centres = scipy.interpolate.CubicSpline(chord, self.nodes)(u)
        return centres, scipy.interpolate.PchipInterpolator(chord, self.radii)(u), at_nodes

    @property
    def points(self) -> np.ndarray:
        """``(m, 3)`` the curve as a fine polyline."""
        return self._samples[0]

    @property
    def point_radii(self) -> np.ndarray:
        """``(m,)`` radius along :attr:`points`."""
        return self._samples[1]

    @cached_property
    def arc(self) -> np.ndarray:
        """``(m,)`` arc length along :attr:`points`."""
        return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @property
    def node_arc(self) -> np.ndarray:
        """``(n,)`` arc length of the nodes."""
        return self.arc[self._samples[2]]

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of a box around the chain's own surface."""
        reach = (self.point_radii / np.linalg.svd(self.metric, compute_uv=False).min())[:, None]
        return (self.points - reach).min(0), (self.points + reach).max(0)

    def image(self, matrix: np.ndarray, name: str, parent: str | None) -> "Chain":
        """The chain moved by an orthogonal matrix (a mirror image, a rotated copy)."""
        return replace(self, name=name, parent=parent, nodes=self.nodes @ matrix.T, metric=self.metric @ matrix.T)


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The chains of one body with the mirror planes of its rest pose.

    Args:
        kind: the creature's kind.
        chains: root first, parents before their children.
        planes: ``(P, 3)`` unit normals of the mirror planes that bound the fundamental domain ``{x: planes @ x >= 0}``.
        skin: width over which neighbouring chains share the skin.
    """

    kind: str
    chains: tuple[Chain, ...]
    planes: np.ndarray
    skin: float

    @cached_property
    def by_name(self) -> dict[str, Chain]:
        """The chains by their names."""
        return {c.name: c for c in self.chains}

    @cached_property
    def orbits(self) -> list[list[int]]:
        """Chain indices, united orbit by orbit in the order in which the orbits first appear."""
        seen: dict[str, list[int]] = {}
        for i, chain in enumerate(self.chains):
            seen.setdefault(chain.orbit or chain.name, []).append(i)
        return list(seen.values())

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of a box that holds the surface."""
        margin = 2 * max(c.blend for c in self.chains)
        return np.min([c.box[0] for c in self.chains], axis=0) - margin, np.max(
            [c.box[1] for c in self.chains], axis=0
        ) + margin

    @cached_property
    def reach(self) -> list[float]:
        """For each orbit the distance beyond which it does not matter for a point of the surface."""
        blend = [self.chains[orbit[0]].blend for orbit in self.orbits]
        return [12 * max(blend[i:]) for i in range(len(blend))]


def reflection_group(planes: Sequence[Any] | np.ndarray) -> np.ndarray:
    """All products of the reflections in the given planes, as matrices.

    Args:
        planes: ``(P, 3)`` unit normals.

    Returns:
        ``(G, 3, 3)`` orthogonal matrices, the identity first, then rotations before reflections.

    Example:
        >>> reflection_group([[1, 0, 0], [0, 1, 0], [0, 0, 1]]).shape
        (8, 3, 3)
    """
    generators = [np.eye(3) - 2 * np.outer(n, n) for n in np.asarray(planes, dtype=float).reshape(-1, 3)]
    group = [np.eye(3)]
    for element in group:  # grows while it is walked through: closure under the generators
        for g in generators:
            product = element @ g
            if not any(np.allclose(product, other, atol=1e-9) for other in group):
                group.append(product)
    rotations = [m for m in group if np.linalg.det(m) > 0]
    return np.stack(rotations + [m for m in group if np.linalg.det(m) < 0])
