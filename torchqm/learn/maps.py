"""From two padded shapes and their features to functional maps, in the full basis or in blocks of even and odd ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.fmap.alignment import points_of_blocks
from torchqm.nn.basis import SymmetrizedBasis
from torchqm.nn.solver import FunctionalMapSolver

__all__ = ["Bases", "Basis", "PairMaps", "bases_of", "solved_maps"]

Item = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Basis:
    """One basis of each shape of a batch.

    Args:
        evals: ``(B, K)``.
        evecs: ``(B, V, K)``, 0 at padding.
        evecs_trans: ``(B, K, V)``, 0 at padding.
        mask: ``(B, K)`` real functions.
    """

    evals: Float[Tensor, "B K"]
    evecs: Float[Tensor, "B V K"]
    evecs_trans: Float[Tensor, "B K V"]
    mask: Bool[Tensor, "B K"]


Bases = tuple[Basis, ...]
"""The full basis; or that of the even functions, and perhaps that of the odd ones."""


@dataclass(frozen=True, eq=False)
class PairMaps:
    """Functional maps of each pair of a batch, one for each block.

    Args:
        bases_x: bases of the first shapes.
        bases_y: bases of the second shapes.
        fmaps_xy: ``(B, Ky, Kx)`` each, take functions on x to functions on y.
        fmaps_yx: ``(B, Kx, Ky)`` each.
    """

    bases_x: Bases
    bases_y: Bases
    fmaps_xy: tuple[Float[Tensor, "..."], ...]
    fmaps_yx: tuple[Float[Tensor, "..."], ...]

    def points(self, verts_mask_y: Bool[Tensor, "B Y"] | None = None) -> Int[Tensor, "B X"]:
        """``p2p_xy``: for each vertex of x the vertex of y nearest to its image, all blocks joined."""
        evecs_x, evecs_y = ([basis.evecs for basis in bases] for bases in (self.bases_x, self.bases_y))
        return points_of_blocks(self.fmaps_xy, evecs_x, evecs_y, verts_mask_y)


def bases_of(item: Item, split: SymmetrizedBasis | None, odd: bool) -> Bases:
    """The bases that a set-up writes its maps in; no gradient goes into them.

    Args:
        item: a padded batch of :func:`torchqm.data.collate`.
        split: None for the full basis, else what makes the even and the odd one.
        odd: whether the odd one is wanted.
    """
    if split is None:
        return (Basis(item["evals"], item["evecs"], item["evecs_trans"], item["evals_mask"]),)
    masks = {name: item[name] for name in ("group_mask", "verts_mask", "evals_mask")}
    with torch.no_grad():
        halves = split(item["evals"], item["evecs"], item["mass"], group=item["group"], **masks)
        bases = [Basis(halves.evals_even, halves.evecs_even, halves.evecs_trans_even, halves.evals_even_mask)]
        if odd:
            bases.append(Basis(halves.evals_odd, halves.evecs_odd, halves.evecs_trans_odd, halves.evals_odd_mask))
    return tuple(bases)


def solved_maps(
    solver: FunctionalMapSolver,
    feat_x: Float[Tensor, "B X C"],
    feat_y: Float[Tensor, "B Y C"],
    bases_x: Bases,
    bases_y: Bases,
    odd_x: Float[Tensor, "B X P"] | None = None,
    odd_y: Float[Tensor, "B Y P"] | None = None,
) -> PairMaps:
    """The maps in both directions by least squares.

    Args:
        solver: with ``bidirectional``.
        feat_x: features of x.
        feat_y: features of y.
        bases_x: one basis, or the even and the odd one.
        bases_y: likewise.
        odd_x: odd descriptors of x, where there is an odd basis.
        odd_y: those of y.
    """
    given: dict[str, Any] = {"evals_mask_x": bases_x[0].mask, "evals_mask_y": bases_y[0].mask}
    if len(bases_x) > 1:
        for side, basis in (("x", bases_x[1]), ("y", bases_y[1])):
            given[f"evals_odd_{side}"], given[f"evecs_trans_odd_{side}"] = basis.evals, basis.evecs_trans
            given[f"evals_odd_mask_{side}"] = basis.mask
        given |= {"extra_x": odd_x, "extra_y": odd_y}
    even_x, even_y = bases_x[0], bases_y[0]
    fmaps_xy, fmaps_yx = solver(
        *(feat_x, feat_y, even_x.evals, even_y.evals, even_x.evecs_trans, even_y.evecs_trans), **given
    )
    if len(bases_x) > 1:
        return PairMaps(bases_x, bases_y, tuple(fmaps_xy), tuple(fmaps_yx))
    return PairMaps(bases_x, bases_y, (fmaps_xy,), (fmaps_yx,))
