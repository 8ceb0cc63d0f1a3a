"""A finite group acting on a shape, as a table of vertex maps."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["GroupResiduals", "SymmetryGroup", "common_order"]


@dataclass(frozen=True)
class GroupResiduals:
    """How far a table of vertex maps is from a group: mean distances, in the unit of the points they were measured in.

    Args:
        closure: largest over pairs (g, h) of the mean distance between ``g o h`` and the nearest element.
        inverse: largest over g of the mean distance between the best ``g o h`` and the identity.
        products: ``(G, G)`` index of the element nearest to ``g o h``.
    """

    closure: float
    inverse: float
    products: Int[Tensor, "G G"]


@dataclass(frozen=True, eq=False)
class SymmetryGroup:
    """A symmetry group of a shape: row g of ``maps`` sends each vertex to its image under the g-th element.

    Row 0 is the identity. The rows need not be permutations: a symmetry of a real mesh sends a vertex to the vertex
    nearest to its image, and two vertices may share it.

    Args:
        maps: ``(G, V)`` int64 vertex ids.

    Raises:
        ValueError: row 0 is not the identity, or an id lies outside ``0..V-1``.

    Example:
        >>> group = SymmetryGroup(torch.tensor([[0, 1, 2], [2, 1, 0]]))
        >>> group.order, group.orbits[0].tolist()
        (2, [0, 2])
    """

    maps: Int[Tensor, "G V"]

    def __post_init__(self) -> None:
        maps = self.maps
        if maps.ndim != 2 or maps.shape[0] < 1:
            raise ValueError(f"maps: expected a (G, V) table with G >= 1, got shape {tuple(maps.shape)}")
        n = maps.shape[1]
        if maps.numel() and (int(maps.min()) < 0 or int(maps.max()) >= n):
            raise ValueError(f"maps: vertex ids must lie in 0..{n - 1}, got {int(maps.min())}..{int(maps.max())}")
        if not torch.equal(maps[0], torch.arange(n)):
            raise ValueError("maps: row 0 must be the identity")

    @classmethod
    def trivial(cls, n_verts: int) -> "SymmetryGroup":
        """The group of a shape without symmetry: the identity alone."""
        return cls(torch.arange(n_verts)[None])

    @classmethod
    def from_reflection(cls, reflection: Int[Tensor, " V"]) -> "SymmetryGroup":
        """The group ``{id, S}`` of one reflection given as a vertex map."""
        return cls(torch.stack([torch.arange(reflection.shape[0]), reflection]))

    @property
    def order(self) -> int:
        """Number of elements |G|."""
        return int(self.maps.shape[0])

    @property
    def n_verts(self) -> int:
        """Number of vertices V of the shape acted on."""
        return int(self.maps.shape[1])

    @cached_property
    def orbits(self) -> Int[Tensor, "V G"]:
        """Row x is the orbit of vertex x: its images under all elements, itself first (paper, section 4.4)."""
        return self.maps.T.contiguous()

    def residuals(self, points: Float[Tensor, "V D"]) -> GroupResiduals:
        """Measure closure and inverses, as mean distances between maps in the given points (positions or spectral)."""
        order = self.order
        closure, inverse = 0.0, 0.0
        products = torch.empty(order, order, dtype=torch.int64)
        for g in range(order):
            to_identity = []
            for h in range(order):
                product = self.maps[g][self.maps[h]]
                gaps = torch.stack([(points[product] - points[m]).norm(dim=1).mean() for m in self.maps])
                products[g, h] = gaps.argmin()
                closure = max(closure, float(gaps.min()))
                to_identity.append(float(gaps[0]))
            inverse = max(inverse, min(to_identity))
        return GroupResiduals(closure, inverse, products)


def common_order(a: SymmetryGroup, b: SymmetryGroup) -> int:
    """The order both groups have, or 1 (the trivial group) where they differ: no isometry relates their symmetries."""
    return a.order if a.order == b.order else 1
