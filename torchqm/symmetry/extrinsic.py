"""The mirror plane of an undeformed shape: many starts, refined by reflective ICP (paper, sections 6.2 and 7)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.geometry.sampling import area_samples
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["ExtrinsicGroup", "ExtrinsicReflection", "extrinsic_group", "find_reflection", "find_reflections"]


@dataclass(frozen=True, eq=False)
class ExtrinsicReflection:
    """A plane, the vertex map of the reflection in it, and how well the shape coincides with its mirror image.

    Args:
        normal: ``(3,)`` unit normal of the plane.
        offset: the plane is ``{x : normal . x = offset}``, in the units of the mesh.
        map: ``(V,)`` for each vertex the vertex nearest to its mirror image.
        residual: root mean square distance (by area) from mirrored vertices to the surface's vertices / sqrt(area).
        residual_max: the largest such distance / sqrt(area).
        spacing: root mean square distance from a vertex to its nearest neighbour / sqrt(area): the residual cannot be
            expected below it where the triangulation is not symmetric.
    """

    normal: Float[Tensor, "3"]
    offset: float
    map: Int[Tensor, " V"]
    residual: float
    residual_max: float
    spacing: float

    def side(self, verts: Float[Tensor, "V 3"]) -> Float[Tensor, " V"]:
        """Signed distance of points from the plane."""
        return verts @ self.normal - self.offset

    @property
    def convincing(self) -> bool:
        """Whether the residual is what a mirror-symmetric shape gives: at most ``sqrt(0.01^2 + (spacing / 2)^2)``.

        Where the triangles left and right have nothing to do with each other, exactly symmetric surfaces gave residuals
        of 0.41 to 0.47 spacings (the creatures of 1k and 4k vertices, retriangulated); the two errors add in squares.
        """
        return self.residual**2 <= 0.01**2 + (self.spacing / 2) ** 2


def find_reflection(mesh: Mesh, n_samples: int = 500, n_refine: int = 3, seed: int = 0) -> ExtrinsicReflection:
    """The first of :func:`find_reflections`: the plane in which the shape is most nearly its own mirror image."""
    return find_reflections(mesh, n_samples, n_refine, seed)[0]


def find_reflections(mesh: Mesh, n_samples: int = 500, n_refine: int = 3, seed: int = 0) -> list[ExtrinsicReflection]:
    """Find the planes in which the shape is most nearly its own mirror image.

    Candidates are the three principal planes and a spread of directions over the half sphere, all through the
    centroid. Each is improved by a few steps of reflective ICP on a sample, the better ones by more of them; those of
    different directions are brought to convergence on more points. One step: mirror the points, find their
    nearest vertices, and take the plane that best maps the points to these partners (normal: eigenvector of least
    eigenvalue of ``sum x y^T + y x^T``, centred; offset through the mean midpoint).

    Args:
        mesh: the shape; any scale.
        n_samples: points in the first stage.
        n_refine: candidates that reach the last stage at least; more do where more fit as well.
        seed: of the samples.

    Returns:
        The best plane, and after it those that fit as well as far as the triangulation tells (their directions differ
        by 10 degrees or more): a box has three, a regular octopus eight. Nothing is refused here: a shape without
        mirror plane gets one with a large residual, and ``convincing`` says so.

    References:
        Paper, section 6.2 (the undeformed shape's reflection is assumed known) and section 7.
    """
    scale = mesh.area**0.5
    verts = mesh.verts.numpy() / scale
    weights = mesh.vertex_areas.numpy() / mesh.area
    centre = weights @ verts
    verts = verts - centre
    used = np.flatnonzero(weights > 0)
    tree = _tree(verts[used])
    drawn = area_samples(mesh, min(max(5000, 4 * n_samples), used.size), seed).numpy()  # any first part is a sample
    few, many = (_ordered(verts[drawn[:n]]) for n in (n_samples, 4 * n_samples))
    coarse = _tree(verts[drawn[:5000]])
    spacing = float(np.sqrt((np.asarray(tree.query(many, k=2)[0])[:, 1] ** 2).mean()))
    coarse_spacing = float(np.sqrt((np.asarray(coarse.query(few, k=2)[0])[:, 1] ** 2).mean()))

    _, axes = np.linalg.eigh((verts * weights[:, None]).T @ verts)
    directions = np.concatenate([axes.T, _half_sphere(45)])
    planes = _Planes(directions, np.zeros(len(directions)))
    for steps, keep in ((3, 24), (5, 16)):
        planes, fits = _ranked(coarse, few, _reflective_icp(coarse, few, planes, steps))
        planes = planes.take(slice(keep))
    planes, fits = _different(planes, fits[: len(planes.offsets)])
    good = int((fits <= fits[0] + coarse_spacing).sum())
    planes, fits = _ranked(tree, many, _reflective_icp(tree, many, planes.take(slice(max(n_refine, good))), 30))
    enough = np.hypot(fits[0], spacing / 2)
    planes = planes.take(fits <= enough)
    # The mirror image of one plane in another is a plane as good: with a few of a dihedral group come all.
    images = _reflective_icp(tree, many, _images(planes), 30)
    planes = planes.join(images.take(_fits(tree, many, images) <= enough))
    planes, _ = _different(planes, np.zeros(len(planes.offsets)))
    found = []
    for normal, offset in zip(planes.normals, planes.offsets, strict=True):
        if normal[np.argmax(np.abs(normal))] < 0:
            normal, offset = -normal, -offset
        distance, partner = _nearest(tree, verts - 2 * np.outer(verts @ normal - offset, normal))
        found.append(
            ExtrinsicReflection(
                normal=torch.from_numpy(normal.copy()),
                offset=float((offset + normal @ centre) * scale),
                map=torch.from_numpy(used[partner]),
                residual=float(np.sqrt(weights @ distance**2)),
                residual_max=float(distance[used].max()),
                spacing=spacing,
            )
        )
    return found


@dataclass(frozen=True, eq=False)
class ExtrinsicGroup:
    """The rigid motions that some mirror planes generate, as vertex maps.

    Args:
        group: identity first, then the reflections in the planes, then the other elements.
        orientation: ``(G,)`` +1 for rotations, -1 for reflections (of any kind).
        residual: the largest root mean square distance from an image of the shape to the shape / sqrt(area).
    """

    group: SymmetryGroup
    orientation: Float[Tensor, " G"]
    residual: float


def extrinsic_group(mesh: Mesh, planes: Sequence[ExtrinsicReflection], most: int = 120) -> ExtrinsicGroup:
    """All products of the reflections in some planes; each is applied to the vertices as one rigid motion.

    Args:
        mesh: the shape.
        planes: its mirror planes (:func:`find_reflections`).
        most: elements at most.

    Raises:
        ValueError: the planes generate more than ``most`` elements: their angles are those of no finite group, or the
            shape is a solid of revolution.
    """
    verts, mass = mesh.verts.numpy(), mesh.vertex_areas.numpy()
    used = np.flatnonzero(mass > 0)
    scale = float(mesh.area) ** 0.5
    tree = _tree(verts[used])
    motions = [(np.eye(3), np.zeros(3))]
    maps, residuals = [np.arange(len(verts))], [0.0]
    for plane in planes:
        n = plane.normal.numpy()
        motions.append((np.eye(3) - 2 * np.outer(n, n), 2 * plane.offset * n))
        maps.append(plane.map.numpy())
        residuals.append(plane.residual)
    pairs = [(a, b) for a in range(1, len(motions)) for b in range(1, len(motions))]
    while pairs:
        a, b = pairs.pop(0)
        turn = motions[a][0] @ motions[b][0]
        if min(float(np.linalg.norm(turn - known)) for known, _ in motions) < 0.3:
            continue
        if len(motions) == most:
            raise ValueError(
                f"{mesh.label}: {len(planes)} mirror planes generate more than {most} elements; the angles between "
                "them are those of no finite group"
            )
        left, _, right = np.linalg.svd(turn)
        shift = motions[a][0] @ motions[b][1] + motions[a][1]
        new = len(motions)
        motions.append((left @ right, shift))
        distance, partner = tree.query(verts @ motions[-1][0].T + shift, workers=torch.get_num_threads())
        maps.append(used[partner])
        residuals.append(float(np.sqrt(mass @ np.asarray(distance) ** 2 / mass.sum())) / scale)
        pairs += [(new, g) for g in range(1, new + 1)] + [(g, new) for g in range(1, new)]
    orientation = torch.tensor([float(np.sign(np.linalg.det(turn))) for turn, _ in motions], dtype=torch.float64)
    return ExtrinsicGroup(SymmetryGroup(torch.from_numpy(np.stack(maps))), orientation, max(residuals))


class _Planes(NamedTuple):
    """``{x : normal . x = offset}`` for several planes at once: ``(P, 3)`` unit normals and ``(P,)`` offsets."""

    normals: np.ndarray
    offsets: np.ndarray

    def take(self, which: np.ndarray | slice | list[int]) -> "_Planes":
        return _Planes(self.normals[which], self.offsets[which])

    def join(self, other: "_Planes") -> "_Planes":
        return _Planes(np.concatenate([self.normals, other.normals]), np.concatenate([self.offsets, other.offsets]))

    def mirror(self, points: np.ndarray) -> np.ndarray:
        """``(P, N, 3)``: the points mirrored in each plane."""
        heights = self.normals @ points.T - self.offsets[:, None]
        return points - 2 * heights[:, :, None] * self.normals[:, None, :]


def _ranked(tree: "scipy.spatial.cKDTree", points: np.ndarray, planes: _Planes) -> tuple[_Planes, np.ndarray]:
    """Planes by their root mean square distance, best first, and these distances."""
    fits = _fits(tree, points, planes)
    order = np.argsort(fits, kind="stable")
    return planes.take(order), fits[order]


def _different(planes: _Planes, fits: np.ndarray, degrees: float = 10.0) -> tuple[_Planes, np.ndarray]:
    """Of planes that nearly agree in direction only the first."""
    near = np.abs(planes.normals @ planes.normals.T) > np.cos(np.radians(degrees))
    kept: list[int] = []
    for i in range(len(near)):
        if not near[i, kept].any():
            kept.append(i)
    return planes.take(kept), fits[kept]


def _images(planes: _Planes, most: int = 16) -> _Planes:
    """Mirror images of planes in one another, and of these again, as far as they have new directions."""
    known = planes
    number = 0
    while number < len(known.offsets) < most:
        normal, offset = known.normals[number], known.offsets[number]
        cosines = planes.normals @ normal
        images = _Planes(
            normal - 2 * cosines[:, None] * planes.normals, np.asarray(offset - 2 * cosines * planes.offsets)
        )
        known, _ = _different(known.join(images), np.zeros(len(known.offsets) + len(cosines)))
        number += 1
    return known.take(slice(len(planes.offsets), None))


def _half_sphere(n: int) -> np.ndarray:
    """``n`` directions spread evenly over the half sphere (a Fibonacci lattice)."""
    height = (np.arange(n) + 0.5) / n
    angle = np.arange(n) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _tree(points: np.ndarray) -> "scipy.spatial.cKDTree":
    """A tree for queries that lie off the points: large leaves and tight boxes less, which is half the time there."""
    return scipy.spatial.cKDTree(points, leafsize=48, compact_nodes=False, balanced_tree=False)


def _ordered(points: np.ndarray) -> np.ndarray:
    """The same points, near ones one after the other: what a query reads of a tree is there for the next one."""
    return points[_tree(points).indices]


def _nearest(tree: "scipy.spatial.cKDTree", points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance, index = tree.query(points, workers=torch.get_num_threads())
    return np.asarray(distance), np.asarray(index)


def _fits(tree: "scipy.spatial.cKDTree", points: np.ndarray, planes: _Planes) -> np.ndarray:
    """``(P,)`` root mean square distance of the mirrored points from the surface."""
    return np.sqrt((_nearest(tree, planes.mirror(points))[0] ** 2).mean(1))


def _reflective_icp(tree: "scipy.spatial.cKDTree", points: np.ndarray, planes: _Planes, steps: int) -> _Planes:
    """Steps of reflective ICP for all the planes at once; those that no longer change are left alone."""
    normals, offsets = planes.normals.copy(), planes.offsets.copy()
    moving = np.arange(len(offsets))
    for _ in range(steps):
        if not moving.size:
            break
        now = _Planes(normals[moving], offsets[moving])
        partners = np.asarray(tree.data)[_nearest(tree, now.mirror(points))[1]]
        middle = (points.mean(0) + partners.mean(1)) / 2
        cross = (points - middle[:, None]).transpose(0, 2, 1) @ (partners - middle[:, None])
        new = np.linalg.eigh(cross + cross.transpose(0, 2, 1))[1][:, :, 0]
        new *= np.where((new * now.normals).sum(1) < 0, -1.0, 1.0)[:, None]
        shift = (new * middle).sum(1)
        change = np.linalg.norm(new - now.normals, axis=1) + np.abs(shift - now.offsets)
        normals[moving], offsets[moving] = new, shift
        moving = moving[change >= 1e-9]
    return _Planes(normals, offsets)
