"""The skin of a skeleton as the zero level of one smooth function."""

import numpy as np

from torchqm.data.creatures.skeleton import Chain, Skeleton

__all__ = ["chain_distance", "field", "near_rows", "project", "thickness", "to_planes"]

_CHUNK = 8192
_FAR = 1e3


def chain_distance(chain: Chain, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth signed distance to one chain, its gradient and the smooth arc length of the nearest point.

    The distances to the chain's round cones are united with a soft minimum ``-k log sum exp(-d / k)``; the cones are
    short beside ``sqrt(radius k)``, so that it swells evenly and not just where two of them meet.

    Args:
        chain: the chain.
        x: ``(N, 3)`` points.

    Returns:
        Distance ``(N,)``, gradient ``(N, 3)`` and arc length ``(N,)``.
    """
    metric = chain.metric
    points = chain.points @ metric.T
    y = x @ metric.T
    start, step = points[:-1], np.diff(points, axis=0)
    length2 = np.maximum((step**2).sum(1), 1e-300)
    r0, dr = chain.point_radii[:-1], np.diff(chain.point_radii)
    offset = [y[:, None, i] - start[None, :, i] for i in range(3)]
    raw = (offset[0] * step[:, 0] + offset[1] * step[:, 1] + offset[2] * step[:, 2]) / length2
    t = np.clip(raw, 0.0, 1.0)
    for i in range(3):
        offset[i] -= t * step[:, i]
    dist = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
    d = dist - (r0 + t * dr)
    width = 0.15 * float(np.median(chain.point_radii)) if len(step) > 1 else 1.0
    low = d.min(1, keepdims=True)
    weight = np.exp((low - d) / width)
    total = weight.sum(1, keepdims=True)
    weight /= total
    value = low[:, 0] - width * np.log(total[:, 0])
    inside = weight * ((raw > 0) & (raw < 1)) * (dr / length2)
    scaled = weight / np.maximum(dist, 1e-12)
    grad = np.stack([(offset[i] * scaled).sum(1) - inside @ step[:, i] for i in range(3)], axis=1) @ metric
    # A first-order distance: exact on the surface, where the metric is not the Euclidean one
    norm = np.maximum(np.linalg.norm(grad, axis=1), 1e-6)
    arc = (weight * (chain.arc[:-1] + t * np.diff(chain.arc))).sum(1)
    return value / norm, grad / norm[:, None], arc


def _soft_min(values: np.ndarray, grads: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    low = values.min(0)
    weight = np.exp((low - values) / width)
    total = weight.sum(0)
    return low - width * np.log(total), np.einsum("pn,pni->ni", weight / total, grads)


def near_rows(chain: Chain, x: np.ndarray, reach: float) -> np.ndarray:
    """Rows of ``x`` within ``reach`` of the chain's box (the others are certainly farther from the chain)."""
    low, high = chain.box
    return np.flatnonzero((np.maximum(np.maximum(low - x, x - high), 0) ** 2).sum(1) < reach**2)


def field(skeleton: Skeleton, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The body's function (negative inside) and its gradient.

    Chains farther than :attr:`Skeleton.reach` are left out; this is exact to about 1e-7 near the surface.

    Args:
        skeleton: the body.
        x: ``(N, 3)`` points.

    Returns:
        Values ``(N,)`` and gradients ``(N, 3)``.
    """
    if len(x) > _CHUNK:
        parts = [field(skeleton, x[i : i + _CHUNK]) for i in range(0, len(x), _CHUNK)]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
    value, grad = np.full(len(x), _FAR), np.zeros((len(x), 3))
    for orbit, reach in zip(skeleton.orbits, skeleton.reach, strict=True):
        width = skeleton.chains[orbit[0]].blend
        rows = [near_rows(skeleton.chains[i], x, reach) for i in orbit]
        some = np.unique(np.concatenate(rows))
        if len(some) == 0:
            continue
        v, g = np.full((len(orbit), len(some)), _FAR), np.zeros((len(orbit), len(some), 3))
        for k, i in enumerate(orbit):
            if len(rows[k]):
                at = np.searchsorted(some, rows[k])
                v[k, at], g[k, at], _ = chain_distance(skeleton.chains[i], x[rows[k]])
        v[0], g[0] = _soft_min(v, g, width)
        value[some], grad[some] = _soft_min(np.stack([value[some], v[0]]), np.stack([grad[some], g[0]]), width)
    return value, grad


def thickness(skeleton: Skeleton, x: np.ndarray) -> np.ndarray:
    """Radius of the body around each surface point (of the thinner direction where a limb is flat).

    Args:
        skeleton: the body.
        x: ``(N, 3)`` points near the surface.

    Returns:
        ``(N,)`` radii, smooth from one chain to the next.
    """
    total, weights = np.zeros(len(x)), np.full(len(x), 1e-30)
    for chain in skeleton.chains:
        rows = near_rows(chain, x, 6 * chain.blend)
        d, _, arc = chain_distance(chain, x[rows])
        weight = np.exp(-np.maximum(d, 0) / chain.blend)
        radius = np.interp(arc, chain.arc, chain.point_radii) / np.linalg.svd(chain.metric, compute_uv=False).max()
        total[rows] += weight * radius
        weights[rows] += weight
    return total / weights


def project(
    skeleton: Skeleton, x: np.ndarray, mask: np.ndarray, limit: float, steps: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Newton steps onto the surface; points on mirror planes stay on them.

    Args:
        skeleton: the body.
        x: ``(N, 3)`` points near the surface.
        mask: ``(N,)`` bit ``i`` set: the point lies on mirror plane ``i``.
        limit: longest step.
        steps: number of Newton steps.

    Returns:
        Moved points ``(N, 3)`` and the unit normals ``(N, 3)`` found at the last step.
    """
    x = to_planes(skeleton.planes, x, mask)
    normal = np.zeros_like(x)
    for _ in range(steps):
        value, grad = field(skeleton, x)
        grad = to_planes(skeleton.planes, grad, mask)
        norm2 = np.maximum((grad**2).sum(1), 1e-6)
        step = grad * (value / norm2)[:, None]
        step *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        x = to_planes(skeleton.planes, x - step, mask)
        normal = grad / np.sqrt(norm2)[:, None]
    return x, normal


def to_planes(planes: np.ndarray, x: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Project each vector onto the intersection of the mirror planes in its mask."""
    x = x.copy()
    for value in np.unique(mask[mask > 0]):
        rows = np.flatnonzero(mask == value)
        normals = planes[[i for i in range(len(planes)) if value >> i & 1]]
        basis = np.linalg.qr(normals.T)[0]
        flat = x[rows] - (x[rows] @ basis) @ basis.T
        for n in normals:  # exact zeros for the coordinate planes
            axis = np.abs(n) == 1
            flat[:, axis] = 0.0
        x[rows] = flat
    return x
