"""Built-in creatures: closed meshes with an exactly known symmetry group, in near-isometric poses."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.data.creatures.bodies import BODIES, build_skeleton
from torchqm.data.creatures.body import Body, is_sound, mesh_asymmetrically, mesh_symmetrically
from torchqm.data.creatures.locate import closest_points, normal_points
from torchqm.data.creatures.motion import draw_pose
from torchqm.data.creatures.pose import deform
from torchqm.data.creatures.surface import field
from torchqm.geometry.mesh import Mesh

__all__ = ["CREATURES", "Creature", "ExactMaps", "creature", "exact_maps", "symmetry_truth"]

CREATURES: tuple[str, ...] = tuple(BODIES)
_SMALLEST, _LARGEST = 500, 400_000


@dataclass(frozen=True, eq=False)
class Creature:
    """A creature in a pose, with the place of each vertex on the body it was made from.

    Args:
        mesh: the posed mesh.
        kind: one of :data:`CREATURES`.
        seed: what drew its proportions.
        pose: what drew its joint angles (0: rest).
        base: the shared triangulation in its rest pose, exactly symmetric in space.
        location_faces: ``(V,)`` int64, the face of ``base`` that each vertex of ``mesh`` lies on (at rest).
        location_bary: ``(V, 3)`` float64 barycentric coordinates in that face.
        base_group: ``(G, V_base)`` int64 permutations of the base's vertices that map faces to faces, identity first.
        orientation: ``(G,)`` int64, +1 where the element keeps orientation (rotation), -1 where not (reflection).
        retriangulated: whether ``mesh`` has other triangles than ``base``.
    """

    mesh: Mesh
    kind: str
    seed: int
    pose: int
    base: Mesh
    location_faces: Int[Tensor, " V"]
    location_bary: Float[Tensor, "V 3"]
    base_group: Int[Tensor, "G B"]
    orientation: Int[Tensor, " G"]
    retriangulated: bool

    @property
    def rest(self) -> Mesh:
        """The mesh's own triangles in the rest pose."""
        corners = self.base.verts[self.base.faces[self.location_faces]]
        return self.mesh.moved((corners * self.location_bary[:, :, None]).sum(1))

    def __repr__(self) -> str:
        how = ", retriangulated" if self.retriangulated else ""
        return (
            f"Creature({self.kind}, seed {self.seed}, pose {self.pose}: {self.mesh.n_verts} vertices, "
            f"{len(self.base_group)} symmetries{how})"
        )


@dataclass(frozen=True, eq=False)
class ExactMaps:
    """For every group element the exact image of each source vertex on the target's surface.

    Args:
        faces: ``(G, V_source)`` int64 target faces.
        bary: ``(G, V_source, 3)`` float64 barycentric coordinates in those faces.
        corners: ``(G, V_source, 3)`` int64 the faces' vertices.
    """

    faces: Int[Tensor, "G V"]
    bary: Float[Tensor, "G V 3"]
    corners: Int[Tensor, "G V 3"]

    def nearest_vertices(self) -> Int[Tensor, "G V"]:
        """``(G, V_source)`` the target vertex with the largest barycentric coordinate."""
        return self.corners.gather(2, self.bary.argmax(2, keepdim=True))[:, :, 0]

    def points(self, mesh: Mesh) -> Float[Tensor, "G V 3"]:
        """``(G, V_source, 3)`` positions of the images on the given (target) mesh."""
        return (mesh.verts[self.corners] * self.bary[..., None]).sum(2)


def _check(kind: str, n_verts: int, **seeds: int) -> None:
    if kind not in CREATURES:
        raise ValueError(f"kind: unknown creature {kind!r}; allowed are {', '.join(CREATURES)}")
    if not isinstance(n_verts, int) or not _SMALLEST <= n_verts <= _LARGEST:
        raise ValueError(f"n_verts: given {n_verts!r}; allowed are integers from {_SMALLEST} to {_LARGEST}")
    for name, value in seeds.items():
        if not isinstance(value, int) or value < 0:
            raise ValueError(f"{name}: given {value!r}; allowed are integers from 0")


@lru_cache(maxsize=16)
def _body(kind: str, n_verts: int, seed: int) -> Body:
    return mesh_symmetrically(build_skeleton(kind, seed), n_verts)


@lru_cache(maxsize=16)
def _retriangulated(kind: str, n_verts: int, seed: int, other: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces, and the place of each vertex on the base."""
    body = _body(kind, n_verts, seed)
    skeleton = build_skeleton(kind, seed)
    normals = field(skeleton, body.verts)[1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for attempt in range(8):
        verts, faces = mesh_asymmetrically(skeleton, n_verts, other + 1000003 * attempt)
        place, bary = normal_points(body.verts, body.faces, normals, verts)
        moved = np.einsum("nk,nki->ni", bary, body.verts[body.faces[place]])
        if len(verts) != len(body.verts) and is_sound(moved, faces):
            return faces, place, bary
    raise RuntimeError(f"the {kind} of seed {seed} could not be retriangulated with {n_verts} vertices")


def creature(kind: str, n_verts: int = 5000, seed: int = 0, pose: int = 0, retriangulate: int = 0) -> Creature:
    """Build a creature.

    Args:
        kind: one of :data:`CREATURES`; their groups have 2 (biped, quadruped), 16 (octopus), 8 (ellipsoid) and
            1 (asymmetric) elements.
        n_verts: wanted number of vertices, 500 to 400000; reached within 5 percent (10 below 1000).
        seed: draws the proportions of the body; the same seed gives the same mesh bit for bit.
        pose: 0 for the rest pose, else a seed for the joint angles.
        retriangulate: 0 for the triangulation that all poses share, else a seed for another one.

    Returns:
        The creature.

    Raises:
        ValueError: on an unknown kind, a size out of range or a negative seed.

    Example:
        >>> c = creature("ellipsoid", n_verts=500)
        >>> len(c.base_group), c.retriangulated
        (8, False)
    """
    _check(kind, n_verts, seed=seed, pose=pose, retriangulate=retriangulate)
    body = _body(kind, n_verts, seed)
    base = Mesh.from_arrays(body.verts, body.faces, f"{kind}-{seed}")
    if retriangulate:
        faces, place, bary = _retriangulated(kind, n_verts, seed, retriangulate)
        rest = np.einsum("nk,nki->ni", bary, body.verts[body.faces[place]])
    else:
        faces, rest = body.faces, body.verts
        place, bary = _incident(body.faces, len(body.verts))
    verts = deform(build_skeleton(kind, seed), draw_pose(kind, pose), rest) if pose else rest.copy()
    name = f"{kind}-{seed}-pose{pose}" + (f"-mesh{retriangulate}" if retriangulate else "")
    return Creature(
        mesh=Mesh.from_arrays(verts, faces, name),
        kind=kind,
        seed=seed,
        pose=pose,
        base=base,
        location_faces=torch.from_numpy(place.copy()),
        location_bary=torch.from_numpy(bary.copy()),
        base_group=torch.from_numpy(body.group.copy()),
        orientation=torch.from_numpy(body.orientation.copy()),
        retriangulated=bool(retriangulate),
    )


def _incident(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """A face at each vertex, and the vertex's barycentric coordinates in it."""
    flat = np.zeros(n, dtype=np.int64)
    flat[faces.reshape(-1)[::-1]] = np.arange(faces.size)[::-1]
    return flat // 3, np.eye(3)[flat % 3]


def _face_images(faces: np.ndarray, permutation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face that each face goes to, and for each of the image's corners the corner that goes there."""
    moved = permutation[faces]
    order, moved_order = np.argsort(faces, axis=1), np.argsort(moved, axis=1)
    n = len(permutation)
    weights = np.array([n * n, n, 1], dtype=np.int64) if n < 2_000_000 else None
    key = np.take_along_axis(faces, order, 1) @ weights
    moved_key = np.take_along_axis(moved, moved_order, 1) @ weights
    by_key = np.argsort(key, kind="stable")
    image = by_key[np.searchsorted(key[by_key], moved_key)]
    corner = np.empty_like(faces)
    np.put_along_axis(corner, order[image], moved_order, 1)
    return image, corner


def exact_maps(source: Creature, target: Creature) -> ExactMaps:
    """The exact dense correspondences between two meshes of one body, one for each symmetry.

    A source vertex lies at a known place of the base; the group element moves that place to another face of the base,
    and there the target's triangle is looked up (by closest point at rest where the target has its own triangles).

    Args:
        source: any pose and triangulation.
        target: a creature of the same kind and seed.

    Returns:
        The maps, element 0 the direct one, in the order of ``source.base_group``.

    Raises:
        ValueError: if the two are not the same body.

    Example:
        >>> a = creature("ellipsoid", 500)
        >>> bool((exact_maps(a, a).nearest_vertices() == a.base_group).all())
        True
    """
    if (source.kind, source.seed) != (target.kind, target.seed):
        raise ValueError(
            f"target: given {target.kind} of seed {target.seed}; allowed is the source's body "
            f"({source.kind} of seed {source.seed})"
        )
    base_verts, base_faces = source.base.numpy()
    place, bary = source.location_faces.numpy(), source.location_bary.numpy()
    same_base = source.base.n_verts == target.base.n_verts and bool(torch.equal(source.base.faces, target.base.faces))
    same_mesh = same_base and source.retriangulated and _same_location(source, target)
    target_faces = target.mesh.faces.numpy()
    rest = target.rest.verts.numpy()
    out_faces, out_bary = [], []
    for number, permutation in enumerate(source.base_group.numpy()):
        image, corner = _face_images(base_faces, permutation)
        face, weight = image[place], np.take_along_axis(bary, corner[place], 1)
        if number == 0 and same_mesh:
            face, weight = _incident(target_faces, source.mesh.n_verts)
        elif target.retriangulated or not same_base:
            points = np.einsum("nk,nki->ni", weight, base_verts[base_faces[face]])
            face, weight = closest_points(rest, target_faces, points)
        out_faces.append(face)
        out_bary.append(weight)
    faces = np.stack(out_faces)
    return ExactMaps(
        torch.from_numpy(faces), torch.from_numpy(np.stack(out_bary)), torch.from_numpy(target_faces[faces])
    )


def _same_location(a: Creature, b: Creature) -> bool:
    return (
        a.mesh.n_verts == b.mesh.n_verts
        and bool(torch.equal(a.mesh.faces, b.mesh.faces))
        and bool(torch.equal(a.location_faces, b.location_faces))
        and bool(torch.equal(a.location_bary, b.location_bary))
    )


def symmetry_truth(c: Creature) -> ExactMaps:
    """The exact symmetries of one creature: :func:`exact_maps` to itself."""
    return exact_maps(c, c)
