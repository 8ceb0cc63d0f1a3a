"""A static mesh renderer on matplotlib alone: painter's algorithm, orthographic camera, soft two-light shading."""

from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import scipy
from jaxtyping import Float, Shaped
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.viz.camera import FRONT, View, project

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.collections

__all__ = ["View", "render_mesh", "to_rgb", "xyz_colors"]

NEUTRAL = (0.80, 0.79, 0.76)
AMBIENT = 0.52
REFINE_BELOW = 16_000  # triangles
LIGHTS = (((-0.45, 0.75, 0.75), 0.46), ((0.85, 0.05, 0.55), 0.16))  # camera coordinates and strength: key, fill
_RGB_TO_LMS = np.array([[0.41222147, 0.53633254, 0.05144599], [0.21190350, 0.68069955, 0.10739696],
                        [0.08830246, 0.28171884, 0.62997870]])  # fmt: skip
_LMS_TO_LAB = np.array([[0.21045426, 0.79361779, -0.00407205], [1.97799850, -2.42859221, 0.45059371],
                        [0.02590404, 0.78277177, -0.80867577]])  # fmt: skip


def xyz_colors(mesh: Mesh) -> Float[np.ndarray, "V 3"]:
    """The three coordinate functions of a shape as red, green and blue, freed of the muddy dark end.

    Each coordinate is stretched to [0, 1] over the shape and read as an sRGB channel; then the perceptual lightness
    (Oklab) is squeezed into the upper half and the hue kept, so that every part of the shape can be told apart and
    shading still reads.

    Args:
        mesh: the shape.

    Returns:
        ``(V, 3)`` sRGB colours in [0, 1].

    Example:
        >>> xyz_colors(Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])).shape
        (3, 3)

    References:
        Ovsjanikov et al. 2013, Figures 1 and 11.
    """
    verts = mesh.numpy()[0]
    used = verts[mesh.referenced.numpy()] if mesh.n_faces else verts
    low, extent = used.min(0), np.ptp(used, axis=0)
    flat = extent <= 1e-9 * max(float(extent.max()), 1e-300)
    rgb = np.where(flat, 0.5, np.clip((verts - low) / np.where(flat, 1.0, extent), 0, 1))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lab = np.cbrt(linear @ _RGB_TO_LMS.T) @ _LMS_TO_LAB.T
    lab[:, 0] = 0.54 + 0.39 * lab[:, 0]
    linear = np.clip((lab @ np.linalg.inv(_LMS_TO_LAB).T) ** 3 @ np.linalg.inv(_RGB_TO_LMS).T, 0, 1)
    return np.clip(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055), 0, 1)


def to_rgb(
    colors: Shaped[Tensor, "V *C"] | Shaped[np.ndarray, "V *C"] | None,
    n_verts: int,
    cmap: str = "viridis",
    limits: tuple[float | int, float | int] | None = None,
) -> Float[np.ndarray, "V 3"]:
    """Vertex colours as RGB, from RGB, from a scalar field through a colour map, or neutral.

    Args:
        colors: ``(V, 3)`` RGB in [0, 1]; or ``(V,)`` scalars (NaN is drawn neutral); or None for a neutral grey.
        n_verts: the number V of vertices.
        cmap: name of a matplotlib colour map, for scalars.
        limits: the scalars at both ends of the colour map; the finite range of the field if None.

    Returns:
        ``(V, 3)`` RGB.

    Raises:
        ValueError: if ``colors`` has another shape or leaves [0, 1].

    Example:
        >>> to_rgb(np.array([0.0, 1.0]), 2, cmap="gray").tolist()
        [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    """
    if colors is None:
        return np.tile(np.array(NEUTRAL), (n_verts, 1))
    values = (colors.detach().cpu().numpy() if isinstance(colors, Tensor) else np.asarray(colors)).astype(np.float64)
    if values.shape not in ((n_verts,), (n_verts, 3)):
        raise ValueError(f"colors: given shape {values.shape}; allowed are ({n_verts},) and ({n_verts}, 3)")
    if values.ndim == 2:
        if not ((values >= -1e-6) & (values <= 1 + 1e-6)).all():
            raise ValueError(f"colors: RGB given in [{values.min():.3g}, {values.max():.3g}]; allowed is [0, 1]")
        return np.clip(values, 0, 1)
    import matplotlib

    finite = np.isfinite(values)
    known = values[finite] if finite.any() else np.zeros(1)
    low, high = limits if limits is not None else (float(known.min()), float(known.max()))
    unit = (np.where(finite, values, low) - low) / (high - low) if high > low else np.full(n_verts, 0.5)
    return np.where(finite[:, None], matplotlib.colormaps[cmap](np.clip(unit, 0, 1))[:, :3], np.array(NEUTRAL))


def _surface(attrs: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool]:
    """What is drawn: small holes filled, parts turned outwards, and whether the result is (consistent, closed).

    ``attrs (V, C)`` starts with the position. Without the filling one looks through the eye sockets of TOSCA's cats
    at the far side of the skull, in the far side's colours.
    """
    n = len(attrs)
    tail, head = faces.T.reshape(-1), faces[:, [1, 2, 0]].T.reshape(-1)
    keys, counts = np.unique(tail * n + head, return_counts=True)
    if counts.max() > 1:
        return attrs, faces, False, False
    rim = ~np.isin(head * n + tail, keys, assume_unique=True)
    closed = not rim.any()
    if not closed:
        tail, head = tail[rim], head[rim]
        _, ring = scipy.sparse.csgraph.connected_components(
            scipy.sparse.coo_array((np.ones(len(tail)), (tail, head)), shape=(n, n)), directed=False
        )
        loop = np.unique(ring[tail], return_inverse=True)[1]
        perimeter = np.bincount(loop, np.linalg.norm(attrs[tail, :3] - attrs[head, :3], axis=1))
        small = perimeter < 0.2 * np.linalg.norm(np.ptp(attrs[:, :3], axis=0))
        middles = np.stack([np.bincount(loop, (attrs[tail, c] + attrs[head, c]) / 2) for c in range(attrs.shape[1])], 1)
        attrs = np.concatenate([attrs, middles / np.bincount(loop)[:, None]])
        faces = np.concatenate([faces, np.stack([head, tail, n + loop], axis=1)[small[loop]]])
        closed = bool(small.all())
    if closed:
        edges = (np.ones(2 * len(faces)), (faces[:, [0, 0]].reshape(-1), faces[:, [1, 2]].reshape(-1)))
        part = scipy.sparse.csgraph.connected_components(
            scipy.sparse.coo_array(edges, shape=(len(attrs),) * 2), directed=False
        )[1][faces[:, 0]]
        volume = np.bincount(part, np.linalg.det(attrs[faces, :3] - attrs[faces, :3].mean((0, 1))))
        faces = np.where((volume[part] < 0)[:, None], faces[:, ::-1], faces)
    return attrs, faces, True, closed


def _corner_normals(points: np.ndarray, faces: np.ndarray, vectors: np.ndarray, smooth: bool) -> np.ndarray:
    """``(F, 3, 3)`` normals at the corners of faces: the vertex's, to hide facets, or the face's at a sharp edge."""
    flat = _unit(vectors)[:, None]
    if not smooth:
        return np.repeat(flat, 3, axis=1)
    at_verts = [np.bincount(faces.reshape(-1), np.repeat(c, 3), len(points)) for c in vectors.T]
    normals = _unit(np.stack(at_verts, axis=1))[faces]
    return np.where((normals * flat).sum(2, keepdims=True) > 0.5, normals, flat)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors scaled to length one along the last axis; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def _refined(corners: np.ndarray) -> np.ndarray:
    """Each triangle of ``(F, 3, C)`` corner attributes split at its edge midpoints into four: ``(4 F, 3, C)``."""
    a, b, c = corners.transpose(1, 0, 2)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def render_mesh(
    ax: "matplotlib.axes.Axes",
    mesh: Mesh,
    colors: Shaped[Tensor, "V *C"] | Shaped[np.ndarray, "V *C"] | None = None,
    *,
    view: View = FRONT,
    shade: bool = True,
    up: str | np.ndarray = "auto",
    cmap: str = "viridis",
    limits: tuple[float | int, float | int] | None = None,
    cull: bool | Literal["auto"] = "auto",
) -> "matplotlib.collections.PolyCollection":
    """Draw a mesh into an axes: its triangles from far to near, shaded, fitted to the axes, without frame or ticks.

    Args:
        ax: the axes; its limits, aspect and frame are set.
        mesh: the shape.
        colors: ``(V, 3)`` RGB in [0, 1], ``(V,)`` scalars, or None (see :func:`to_rgb`).
        view: where the camera stands.
        shade: two-light Lambert shading; otherwise the colours as they are.
        up: ``"auto"``, a coordinate direction, or a frame (see :func:`project`).
        cmap: colour map of scalars.
        limits: scalars at the ends of the colour map.
        cull: leave out triangles that face away from the camera. ``"auto"`` does it for closed surfaces of consistent
            orientation (turned outwards first) and draws every other surface from both sides; True trusts the
            orientation as given; False draws both sides.

    Returns:
        The collection of triangles, in drawing order.

    Raises:
        ValueError: if ``colors`` or ``up`` does not fit, or the mesh has no faces.

    Example:
        >>> from matplotlib.figure import Figure
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]])
        >>> len(render_mesh(Figure().add_subplot(), mesh, up="z").get_paths())  # coarse triangles are split
        64
    """
    from matplotlib.collections import PolyCollection

    if not mesh.n_faces:
        raise ValueError(f"mesh: given {mesh.label} without faces; allowed are meshes with at least one")
    faces = mesh.numpy()[1]
    attrs = np.concatenate([project(mesh, view, up), to_rgb(colors, mesh.n_verts, cmap, limits)], axis=1)
    seen = attrs[mesh.referenced.numpy(), :2]
    consistent, closed = True, True
    if cull is not True:
        attrs, faces, consistent, closed = _surface(attrs, faces)
    vectors = np.cross(*(attrs[faces[:, i], :3] - attrs[faces[:, 0], :3] for i in (1, 2)))
    normals = _corner_normals(attrs, faces, vectors, consistent)
    away = vectors[:, 2] <= 0
    normals[away] *= -1
    corners = np.concatenate([attrs[faces], normals], axis=2)
    push = np.zeros(len(faces))
    if cull is True or (cull == "auto" and closed):
        corners, push = corners[~away], push[~away]
    elif consistent:  # of two sheets that touch, the one that faces the camera covers the other
        push = np.where(away, np.ptp(corners[:, :, :3], axis=1).max(1), 0.0)
    for _ in range(3):  # coarse meshes: colour and light interpolated inside the triangles
        if len(corners) <= REFINE_BELOW:
            corners, push = _refined(corners), np.tile(push, 4)
    middle = corners.mean(1)
    face_rgb = middle[:, 3:6]
    if shade:
        light = np.full(len(middle), AMBIENT)
        for direction, strength in LIGHTS:
            light += strength * np.clip(_unit(middle[:, 6:]) @ _unit(np.array(direction)), 0, None)
        face_rgb = face_rgb * light[:, None]
    order = np.argsort(middle[:, 2] - push, kind="stable")
    polygons = PolyCollection(
        cast(Any, corners[order][:, :, :2]),  # arrays take a faster path than the lists of the stubs
        facecolors=np.clip(face_rgb[order], 0, 1),
        edgecolors="face",  # a hairline in the face's own colour closes the seams that antialiasing leaves
        linewidths=0.4,
        joinstyle="round",
        rasterized=True,
    )
    ax.add_collection(polygons, autolim=False)
    centre, half = (seen.max(0) + seen.min(0)) / 2, np.ptp(seen, axis=0) / 2
    half = 1.03 * np.maximum(half, 1e-3 * max(float(half.max()), 1e-300))
    ax.set(xlim=(centre[0] - half[0], centre[0] + half[0]), ylim=(centre[1] - half[1], centre[1] + half[1]))
    ax.set_aspect("equal")
    ax.set_axis_off()
    return polygons
