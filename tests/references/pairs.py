"""Pairs of shapes whose maps are known: exact copies in another order, and two poses of one creature."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from references.shapes import Shape, blob, renumbered
from torch import Tensor

from torchqm.data.synthetic import Creature, creature
from torchqm.geometry import Mesh
from torchqm.matching import MatchParameters, PreparedShape, prepare
from torchqm.symmetry import SymmetryGroup

K = 60
FAST = MatchParameters(k_max=K, icp_steps=10)
"""Parameters for meshes of a few hundred vertices, where the full ones only cost time."""


def mirrored(mesh: Mesh) -> Mesh:
    """The mirror image in ``y = 0`` with its normals outward again: the same metric, the other orientation."""
    flip = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    return Mesh(mesh.verts * flip, mesh.faces.flip(1), f"{mesh.name} mirrored")


def reordered(mesh: Mesh, seed: int) -> tuple[Mesh, Tensor, Tensor]:
    """The mesh with its vertices in another order, the old id of each new vertex, and the new id of each old one."""
    old = torch.randperm(mesh.n_verts, generator=torch.Generator().manual_seed(seed))
    new = torch.argsort(old)
    return Mesh(mesh.verts[old], new[mesh.faces], mesh.name), old, new


def with_loose_vertices(mesh: Mesh, places: Sequence[int]) -> tuple[Mesh, Tensor]:
    """Vertices of no face put in at the given new ids, right on top of others; and the new ids of the old ones."""
    n = mesh.n_verts + len(places)
    loose = torch.zeros(n, dtype=torch.bool)
    loose[list(places)] = True
    ids = (~loose).nonzero().flatten()
    verts = mesh.verts[torch.arange(n) % mesh.n_verts].clone()
    verts[ids] = mesh.verts
    return Mesh(verts, ids[mesh.faces], f"{mesh.name} with loose vertices"), ids


class ExactPair(NamedTuple):
    """A blob and its renumbered copy (perhaps mirrored), with groups and the exact vertex maps between them."""

    x: PreparedShape
    y: PreparedShape
    group_x: SymmetryGroup
    group_y: SymmetryGroup
    p2p_xy: Tensor
    p2p_yx: Tensor

    @property
    def side_x(self) -> Tensor:
        """-1 left, +1 right, 0 exactly on the axis (for the group of one reflection, in x = 0)."""
        return side_of(self.x, self.group_x)

    @property
    def side_y(self) -> Tensor:
        return side_of(self.y, self.group_y)


def side_of(shape: PreparedShape, group: SymmetryGroup) -> Tensor:
    stays = group.maps[1] == torch.arange(group.n_verts)
    return torch.where(stays, 0.0, torch.sign(shape.mesh.verts[:, 0]))


def exact_pair(order: int = 2, mirror: bool = False) -> ExactPair:
    """Made once for the whole run."""
    return _exact_pair(order, mirror)


@lru_cache
def _exact_pair(order: int, mirror: bool) -> ExactPair:
    if mirror:
        pair = exact_pair(order)
        return pair._replace(y=prepare(mirrored(renumbered(blob(order), 2).shape.mesh), K))
    shape = blob(order)
    copy = renumbered(shape, 2)
    return ExactPair(
        prepare(shape.mesh, K), prepare(copy.shape.mesh, K), shape.group, copy.shape.group, copy.p2p_xy, copy.p2p_yx
    )


def blob_meshes(order: int = 2) -> tuple[Shape, Shape]:
    """The unprepared meshes of :func:`exact_pair` with their groups."""
    return blob(order), renumbered(blob(order), 2).shape


class Posed(NamedTuple):
    """Two poses of one creature and the rest pose, in one triangulation."""

    source: Creature
    target: Creature
    rest: Creature


@lru_cache
def posed(kind: str = "quadruped", n_verts: int = 600) -> Posed:
    return Posed(*(creature(kind, n_verts, 0, pose) for pose in (1, 2, 0)))
