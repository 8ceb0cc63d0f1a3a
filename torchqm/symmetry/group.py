"""A finite group acting on a shape, as a table of vertex maps."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.symmetry.algebra import group_fault, group_name

__all__ = ["GroupResiduals", "SymmetryGroup"]

N_COMPARED = 500
"""Maps are compared at this many vertices at most: enough for means to a few percent, and quick for 48 maps."""
N_ROUGH, N_LIKELY = 50, 3
"""A first look at N_ROUGH of them (or a few more) chooses the N_LIKELY elements that may be nearest to a product."""


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

    @cached_property
    def fault(self) -> str | None:
        """What keeps the table of nearest products from being a group; None if nothing does."""
        return group_fault(self.products)

    @property
    def is_group(self) -> bool:
        """Whether the nearest products obey the axioms exactly; how near they are is for ``closure`` to say."""
        return self.fault is None

    @property
    def name(self) -> str:
        """Name of the abstract group (:func:`torchqm.symmetry.algebra.group_name`), or "no group"."""
        return group_name(self.products) if self.is_group else "no group"


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

    @classmethod
    def from_generators(
        cls,
        generators: Sequence[Int[Tensor, " V"]],
        points: Float[Tensor, "V D"],
        tolerance: float,
        most: int = 120,
        weights: Float[Tensor, " V"] | None = None,
    ) -> "SymmetryGroup":
        """The group that some vertex maps generate: all their products, up to a tolerance.

        A product whose mean distance to the nearest known element is at most ``tolerance`` is that element, else it is
        a new one. Vertex maps send to the *nearest* vertex, so the errors of a long product add up: elements are found
        breadth-first, each as one of its shortest words in the generators, and stay as they were found.

        Args:
            generators: vertex maps; one that is the identity, or equal to another, up to the tolerance counts as such.
            points: ``(V, D)`` positions in which distances are measured: of vertices if the symmetries are rigid, else
                intrinsic ones (spectral coordinates).
            tolerance: largest mean distance (unit of the points) at which two maps count as the same element. Errors
                of short products should lie well below, distances between different elements well above.
            most: largest order of the group.
            weights: ``(V,)`` areas by which the means are weighted; all equal if not given.

        Returns:
            The identity, then the generators, then products of two of them, and so on.

        Raises:
            ValueError: more than ``most`` elements appear, or the elements' nearest products are no group (with the
                distances that were met); lengths, ids, tolerance or ``most`` make no sense.

        Example:
            >>> corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            >>> turn, flip = torch.tensor([1, 2, 3, 0]), torch.tensor([1, 0, 3, 2])
            >>> square = SymmetryGroup.from_generators([turn, flip], corners, tolerance=0.1)
            >>> square.order, square.residuals(corners).name
            (8, 'D4')
        """
        if not tolerance >= 0 or most < 1:
            raise ValueError(f"tolerance is {tolerance}, most is {most}: allowed are tolerance >= 0 and most >= 1")
        n = points.shape[0]
        for i, generator in enumerate(generators):
            if generator.shape != (n,) or (n and (int(generator.min()) < 0 or int(generator.max()) >= n)):
                raise ValueError(f"generators: number {i} is no map of {n} vertices (as many as there are points)")
        ids, share = _compared(n, weights)
        elements = [torch.arange(n)]
        images = points[ids].double()[None]
        nearest_new, farthest_known = float("inf"), 0.0
        for element in elements:  # grows as it is read: breadth-first
            for generator in generators:
                product = generator[element]
                image = points[product[ids]].double()
                gap = float(((images - image).norm(dim=2) @ share).min())
                if gap <= tolerance:
                    farthest_known = max(farthest_known, gap)
                    continue
                nearest_new = min(nearest_new, gap)
                if len(elements) == most:
                    raise ValueError(
                        f"the generators do not close: more than most={most} elements appear with "
                        f"tolerance={tolerance:.3g}; products that counted as new were {nearest_new:.3g} or more away "
                        f"from every known element, products that counted as known {farthest_known:.3g} or less"
                    )
                elements.append(product)
                images = torch.cat([images, image[None]])
        group = cls(torch.stack(elements))
        found = group.residuals(points, weights)
        if not found.is_group:
            raise ValueError(
                f"the generators do not close: the nearest products of the {group.order} elements found with "
                f"tolerance={tolerance:.3g} are no group, {found.fault}; products that counted as new were "
                f"{nearest_new:.3g} or more away from every known element, products that counted as known "
                f"{farthest_known:.3g} or less, and the closure residual is {found.closure:.3g}"
            )
        return group

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

    def subset(self, elements: Sequence[int]) -> "SymmetryGroup":
        """Some of the elements, in the given order: a subgroup if they are one (:func:`torchqm.symmetry.subgroup`).

        Args:
            elements: different element ids, the identity 0 first.

        Raises:
            ValueError: the first is not 0, or one is repeated or no element.
        """
        ids = list(elements)
        if ids[:1] != [0] or len(set(ids)) != len(ids) or not all(0 <= g < self.order for g in ids):
            raise ValueError(f"elements are {ids}: 0 first, then different ones of 1 to {self.order - 1} are allowed")
        return SymmetryGroup(self.maps[ids])

    def residuals(self, points: Float[Tensor, "V D"], weights: Float[Tensor, " V"] | None = None) -> GroupResiduals:
        """Measure closure and inverses, as mean distances between maps in the given points (positions or spectral).

        Where there are more than :data:`N_COMPARED` vertices the means are over that many of them, at even steps of
        the vertex numbers.

        Args:
            points: ``(V, D)`` positions of the vertices.
            weights: ``(V,)`` areas by which the means are weighted; all equal if not given.

        Raises:
            ValueError: there are not as many points or weights as the group acts on, or no weight is positive.
        """
        if points.shape[0] != self.n_verts:
            raise ValueError(f"points: {points.shape[0]} given, but the group acts on {self.n_verts} vertices")
        ids, share = _compared(self.n_verts, weights)
        order, step = self.order, max(1, len(ids) // N_ROUGH)
        starts = self.maps[:, ids].T  # (S, G): where each element sends the vertices compared
        images = points[starts].double()
        closure, inverse = 0.0, 0.0
        products = torch.empty(order, order, dtype=torch.int64)
        for g, element in enumerate(self.maps):
            moved = points[element[starts]].double()
            rough = _gaps(moved[::step], images[::step]).mean(0)
            likely = rough.topk(min(N_LIKELY, order), largest=False).indices.sort(dim=1).values
            means = share @ _gaps(moved[:, :, None], images[:, likely]).flatten(1)
            nearest, which = means.reshape(likely.shape).min(1)
            products[g] = likely.gather(1, which[:, None])[:, 0]
            closure = max(closure, float(nearest.max()))
            inverse = max(inverse, float((share @ _gaps(moved, images[:, :1])[:, :, 0]).min()))
        return GroupResiduals(closure, inverse, products)


def _gaps(a: Tensor, b: Tensor) -> Tensor:
    # Without matrix products, which would make equal points 1e-8 apart.
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _compared(n: int, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """At most N_COMPARED vertices at even steps of their numbers, and their shares in a mean (sum 1)."""
    if weights is None:
        weights = torch.ones(n, dtype=torch.float64)
    if weights.shape != (n,) or not bool((weights > 0).any()):
        raise ValueError(f"weights: {n} areas, some of them positive, are needed; got {tuple(weights.shape)}")
    ids = (weights > 0).nonzero()[:, 0]
    if len(ids) > N_COMPARED:
        ids = ids[torch.linspace(0, len(ids) - 1, N_COMPARED, dtype=torch.float64).long()]
    share = weights[ids].double()
    return ids, share / share.sum()
