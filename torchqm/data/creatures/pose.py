"""Poses: each chain is a rod that bends smoothly at its joints; the skin follows the rods."""

import numpy as np

from torchqm.data.creatures.skeleton import Chain, Skeleton
from torchqm.data.creatures.surface import chain_distance

__all__ = ["deform", "rotation"]

_CHUNK = 16384
_FINE = 16


def rotation(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices ``(N, 3, 3)`` of rotation vectors ``(N, 3)`` (axis times angle in radians).

    Example:
        >>> rotation(np.array([[0.0, 0.0, np.pi / 2]])).round(6)[0, :, 0]
        array([0., 1., 0.])
    """
    angle = np.linalg.norm(vectors, axis=1)
    x, y, z = (vectors / np.maximum(angle, 1e-300)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    sin, cos = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sin * cross + (1 - cos) * (cross @ cross)


class _Rod:
    """One chain in its pose: the frame ``R(s)`` and the curve ``c'(s) = int R dc`` at each arc length ``s``."""

    def __init__(self, chain: Chain, angles: np.ndarray, parent: "_Rod | None") -> None:
        self.chain, self.angles = chain, angles
        root = chain.points[0]
        if parent is None:
            self.base, origin = rotation(angles[-1:])[0] if len(angles) > len(chain.joints) else np.eye(3), root
        else:
            at = np.interp(0.0, [0.0], [parent.nearest(root)])
            self.base = parent.frames(np.array([at]))[0]
            origin = parent.move(root[None], np.array([at]))[0]
        arc, points = chain.arc, chain.points
        fine = np.unique(np.concatenate([np.linspace(arc[i], arc[i + 1], _FINE + 1) for i in range(len(arc) - 1)]))
        curve = np.stack([np.interp(fine, arc, points[:, i]) for i in range(3)], 1)
        steps = np.einsum("nij,nj->ni", self.frames((fine[1:] + fine[:-1]) / 2), np.diff(curve, axis=0))
        self.fine, self.curve = fine, curve
        self.posed = origin + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def nearest(self, point: np.ndarray) -> float:
        return float(chain_distance(self.chain, point[None])[2][0])

    def frames(self, s: np.ndarray) -> np.ndarray:
        out = np.broadcast_to(self.base, (len(s), 3, 3))
        for joint, angle in zip(self.chain.joints, self.angles, strict=False):
            t = np.clip((s - self.chain.node_arc[joint.node]) / joint.width + 0.5, 0, 1)
            ease = t * t * t * (10 - 15 * t + 6 * t * t)
            out = out @ rotation(ease[:, None] * angle)
        return out

    def move(self, x: np.ndarray, s: np.ndarray) -> np.ndarray:
        old = np.stack([np.interp(s, self.fine, self.curve[:, i]) for i in range(3)], 1)
        new = np.stack([np.interp(s, self.fine, self.posed[:, i]) for i in range(3)], 1)
        return new + np.einsum("nij,nj->ni", self.frames(s), x - old)


def deform(skeleton: Skeleton, angles: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
    """Move points of the rest pose into a pose.

    A point goes with each rod by the rigid motion at its own arc length, ``x' = c'(s) + R(s) (x - c(s))``, and the
    rods' answers are mixed with weights that fall off smoothly with the distance to each rod. The result depends on
    the rest position only, so every triangulation of the same body is deformed alike.

    Args:
        skeleton: the body.
        angles: for a chain's name ``(J, 3)`` rotation vectors of its joints (the root chain may have one row more:
            the turn of the whole body).
        x: ``(N, 3)`` points on the skin at rest.

    Returns:
        ``(N, 3)`` posed points.
    """
    rods: dict[str, _Rod] = {}
    for chain in skeleton.chains:
        parent = rods[chain.parent] if chain.parent is not None else None
        rods[chain.name] = _Rod(chain, angles.get(chain.name, np.zeros((0, 3))), parent)
    out = np.empty_like(x)
    for begin in range(0, len(x), _CHUNK):
        part = x[begin : begin + _CHUNK]
        found = [chain_distance(c, part) for c in skeleton.chains]
        d = np.stack([f[0] for f in found])
        weight = np.exp((d.min(0) - d) / skeleton.skin)
        weight = np.maximum(weight - 1e-3, 0)
        weight /= weight.sum(0)
        total = np.zeros_like(part)
        for chain, (_, _, arc), w in zip(skeleton.chains, found, weight, strict=True):
            rows = np.flatnonzero(w)
            total[rows] += w[rows, None] * rods[chain.name].move(part[rows], arc[rows])
        out[begin : begin + _CHUNK] = total
    return out
