"""The orthographic camera: which way is up, where it stands, and what it sees."""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Float

from torchqm.geometry.mesh import Mesh

__all__ = ["View", "auto_frame", "project", "up_scores"]

_UPS = {"x": (2, 0, 1), "y": (0, 1, 2), "z": (1, 2, 0)}  # right, up, front: a right-handed triple of axes


@dataclass(frozen=True)
class View:
    """Where an orthographic camera stands, in degrees, relative to the shape's own right/up/front frame.

    Args:
        elev: height above the horizon.
        azim: turn about the up axis, from the front (0) towards the shape's right (90); right is drawn right at 0.

    Example:
        >>> View(elev=0, azim=30).behind()
        View(elev=0, azim=210)
    """

    elev: float | int = 14.0
    azim: float | int = 35.0

    def behind(self) -> "View":
        """The camera on the other side, at the same height."""
        return replace(self, azim=self.azim + 180)


FRONT = View()


def _flat_hull(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Area and half-plane equations of the hull of points in the plane; area 0 when they lie on a line."""
    try:
        hull = scipy.spatial.ConvexHull(points)
    except (scipy.spatial.QhullError, ValueError):  # fewer than three points, or all on a line
        return 0.0, np.zeros((0, 3))
    return float(hull.volume), hull.equations


def up_scores(mesh: Mesh) -> Float[np.ndarray, "3 2"]:
    """How well a shape stands in each of the six coordinate directions taken as up.

    ``prior * footprint^(1/4) * balance * centroid height^2``: the hull of the lowest points against that of all, how
    far the centroid is from standing above it, and how high the body is carried. With these exponents 26 of 27 cats,
    centaurs, davids and wolves of TOSCA stand upright, most rearing ones included.

    Args:
        mesh: the shape.

    Returns:
        ``(3, 2)`` scores of x, y, z as up (column 0) and as down (column 1); all 0 for a flat shape.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> bool(up_scores(mesh).any())
        False
    """
    points, centroid = _body(mesh)
    scores = np.zeros((3, 2))
    for axis in range(3):
        flat = [i for i in range(3) if i != axis]
        whole, _ = _flat_hull(points[:, flat])
        extent = float(np.ptp(points[:, axis]))
        if whole <= 0 or extent <= 0:
            continue
        for column, sign in enumerate((1.0, -1.0)):
            height = sign * points[:, axis]
            ground = float(height.min())
            foot, planes = _flat_hull(points[height - ground <= 0.04 * extent][:, flat])
            outside = (planes[:, :2] @ centroid[flat] + planes[:, 2]).max(initial=0.0) / whole**0.5
            if foot <= 0:
                outside = 3.0  # stands on a point or an edge
            carried = (sign * centroid[axis] - ground) / extent
            # files are y-up or z-up, hardly ever anything else
            prior = (0.5 if axis == 0 else 1.0) * (1.0 if sign > 0 else 0.2)
            scores[axis, column] = prior * (foot / whole + 1e-4) ** 0.25 * np.exp(-outside) * carried**2
    return scores


def _body(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The referenced vertices and the area-weighted centroid."""
    verts = mesh.numpy()[0]
    weight = mesh.vertex_areas.numpy() + 1e-300
    return verts[mesh.referenced.numpy()], (weight[:, None] * verts).sum(0) / weight.sum()


def auto_frame(mesh: Mesh, up: Float[np.ndarray, "3"] | None = None) -> Float[np.ndarray, "3 3"]:
    """Guess the frame to look at a shape from: which way is up, and which side shows most of it.

    The front looks along the smaller horizontal principal axis, so that the larger horizontal extent lies in the
    picture; of its two sides the one is taken that turns the higher end of a long shape (a head) or, failing that, its
    feet towards the camera.

    Args:
        mesh: the shape.
        up: unit vector upwards; the best of :func:`up_scores` if None.

    Returns:
        ``(3, 3)`` rows right, up, front: orthonormal, right-handed.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [4, 0, 0], [2, 1, 0], [2, 0.5, 2]],
        ...                         [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
        >>> auto_frame(mesh, np.array([0.0, 0, 1]))[0].tolist()
        [1.0, 0.0, 0.0]
    """
    points, centroid = _body(mesh)
    if up is None:
        scores = up_scores(mesh)
        if scores.any():
            axis, column = np.unravel_index(int(scores.argmax()), scores.shape)
        else:  # a flat shape: look at it from above
            axis, column = np.intp(1 if int(np.ptp(points, axis=0).argmin()) == 2 else 2), np.intp(0)
        up = np.eye(3)[axis] * (-1.0 if column else 1.0)
    level = np.linalg.svd(up[None])[2][1:]  # two horizontal directions
    spread = (mesh.numpy()[0] - centroid) @ level.T
    front = np.linalg.eigh((spread * mesh.vertex_areas.numpy()[:, None]).T @ spread)[1][:, 0] @ level
    straight = int(np.abs(front).argmax())
    if abs(front[straight]) > 0.9 and abs(up[straight]) < 1e-9:  # within 25 degrees of a coordinate axis: look squarely
        front = np.eye(3)[straight] * np.sign(front[straight])
    right = np.cross(up, front)
    height = points @ up
    top, low = (np.quantile(height, q) for q in (0.9, 0.1))
    head = float((points[height >= top].mean(0) - centroid) @ right) / max(float(np.ptp(points @ right)), 1e-300)
    toes = float((points[height <= low].mean(0) - centroid) @ front)
    if (head if abs(head) > 0.12 else toes) < 0:
        front, right = -front, -right
    return np.stack([right, up, front]) + 0.0


def _frame(mesh: Mesh, up: str | np.ndarray) -> np.ndarray:
    """The right/up/front rows that ``up`` stands for."""
    if isinstance(up, np.ndarray):
        if up.shape != (3, 3) or not np.allclose(up @ up.T, np.eye(3), atol=1e-6):
            raise ValueError(f"up: given an array of shape {up.shape}; allowed are 3 orthonormal rows right, up, front")
        return up
    if up == "auto":
        return auto_frame(mesh)
    if up.lstrip("-") not in _UPS or up.count("-") > 1:
        raise ValueError(f"up: given {up!r}; allowed are 'auto', 'x', 'y', 'z', '-x', '-y', '-z' or a (3, 3) array")
    rows = np.eye(3)[list(_UPS[up[-1]])]
    if up[-1] == "z":  # the custom of Blender and matplotlib: x to the right, looking along +y
        rows = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return rows * np.array([[1.0], [-1], [-1]]) if up[0] == "-" else rows


def project(mesh: Mesh, view: View = FRONT, up: str | np.ndarray = "auto") -> Float[np.ndarray, "V 3"]:
    """Positions in camera coordinates: to the right, upwards, towards the camera (units of the mesh).

    Args:
        mesh: the shape.
        view: where the camera stands.
        up: ``"auto"`` (:func:`auto_frame`), a coordinate direction such as ``"y"`` or ``"-z"``, or the three
            orthonormal rows right, up, front themselves.

    Returns:
        ``(V, 3)`` camera coordinates.

    Raises:
        ValueError: if ``up`` is none of these.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 0, 2]], [[0, 1, 2]])
        >>> project(mesh, View(elev=0, azim=0), up="z").tolist()
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
    """
    right, upward, front = _frame(mesh, up)
    elev, azim = np.deg2rad(view.elev), np.deg2rad(view.azim)
    level = np.cos(azim) * front + np.sin(azim) * right
    toward = np.cos(elev) * level + np.sin(elev) * upward
    across = np.cos(azim) * right - np.sin(azim) * front
    return mesh.numpy()[0] @ np.stack([across, np.cross(toward, across), toward], axis=1) + 0.0
