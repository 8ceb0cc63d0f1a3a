"""The network of a matcher, in bare torch: features, maps, and the losses they are trained with."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from torchqm.fmap.alignment import alignment_energy
from torchqm.fmap.orbit_truth import point_weights
from torchqm.fmap.straight_errors import error_means, straight_errors
from torchqm.geometry.mean_square import unit_mean_square
from torchqm.learn.features import FeatureNet
from torchqm.learn.maps import Basis, PairMaps, bases_of, solved_maps
from torchqm.learn.options import NetOptions
from torchqm.nn import (
    FunctionalMapLoss,
    FunctionalMapSolver,
    OrientationDescriptors,
    PointToOrbitLoss,
    SoftPointMap,
    SymmetrizedBasis,
)

__all__ = ["MatchNet", "Matched", "has_truth"]

Item = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Matched:
    """What the network makes of a batch of pairs.

    Args:
        maps: functional maps in both directions.
        points_x: ``(B, X, D)`` what the soft point maps compare: the features and, with an odd block, its descriptors.
        points_y: ``(B, Y, D)``.
    """

    maps: PairMaps
    points_x: Float[Tensor, "B X D"]
    points_y: Float[Tensor, "B Y D"]


class MatchNet(nn.Module):
    """Features of two shapes and the maps between them, with the losses of one of three set-ups.

    * ``functional_map``: one map in the full bases, as the usual learned pipelines have it.
    * ``quotient``: one map between the even functions: where an orbit goes, and nothing of left and right.
    * ``quotient+odd``: an even and an odd block. The odd one comes from
      :class:`torchqm.nn.OrientationDescriptors` of the features, so that the joined map is the direct one.

    The loss is the sum of the terms with a weight above 0, each a mean over the pairs: ``l_bij, l_orth, l_lap``
    (:class:`torchqm.nn.FunctionalMapLoss`) and ``l_align`` (:func:`torchqm.fmap.alignment.alignment_energy`) over
    blocks and directions, and with a supervision ``l_truth`` (:class:`torchqm.nn.PointToOrbitLoss`). A plain
    supervision is the same loss with the group of one element, or with the spectral form in the full bases.
    A pair without a truth has the term 0 and stays in the mean, so that what a pair adds to the gradient does not
    depend on the others in its batch, nor on which process has them.

    Args:
        options: all plain values.

    Example:
        >>> net = MatchNet(NetOptions(setup="quotient", channels=16, width=16))
        >>> sum(p.numel() for p in net.parameters())
        1584
    """

    def __init__(self, options: NetOptions | None = None) -> None:
        super().__init__()
        self.options = o = options or NetOptions()
        self.features = FeatureNet(o)
        self.solver = FunctionalMapSolver(o.lmbda, bidirectional=True)
        self.soft = SoftPointMap(o.tau)
        self.usual = FunctionalMapLoss(o.w_bij, o.w_orth, o.w_lap)
        self.truth = PointToOrbitLoss(o.truth_form)
        self.split = None if o.setup == "functional_map" else SymmetrizedBasis()
        n = self.features.channels
        self.odd = OrientationDescriptors(n, min(o.odd_pairs, n * (n - 1) // 2))

    def forward(self, x: Item, y: Item) -> Matched:
        """Maps between the shapes of two padded batches of :func:`torchqm.data.collate`."""
        feat_x, feat_y = self.describe(x), self.describe(y)
        with _whole_precision(x):
            return self._matched(x, y, feat_x, feat_y)

    def _matched(self, x: Item, y: Item, feat_x: Tensor, feat_y: Tensor) -> Matched:
        with_odd = self.options.setup == "quotient+odd"
        bases_x, bases_y = (bases_of(item, self.split, with_odd) for item in (x, y))
        if not with_odd:
            return Matched(solved_maps(self.solver, feat_x, feat_y, bases_x, bases_y), feat_x, feat_y)
        odd_x, odd_y = self._odd(feat_x, x, bases_x[1]), self._odd(feat_y, y, bases_y[1])
        maps = solved_maps(self.solver, feat_x, feat_y, bases_x, bases_y, odd_x, odd_y)
        points = (normalize(torch.cat(pair, -1), dim=-1) for pair in ((feat_x, odd_x), (feat_y, odd_y)))
        return Matched(maps, *points)

    def describe(self, item: Item) -> Float[Tensor, "B V C"]:
        """Features of length one at each vertex of a padded batch: the descriptors that maps are solved from."""
        return normalize(self.features(item).to(item["mass"].dtype), dim=-1)

    def losses(self, batch: Mapping[str, Any], matched: Matched | None = None) -> dict[str, Float[Tensor, ""]]:
        """The terms of the loss by name, weighted; each a mean over the pairs of the batch.

        Args:
            batch: pairs of :func:`torchqm.data.collate`; with a supervision, both shapes have ``corr``.
            matched: what :meth:`forward` made of it, if that is known already.

        Raises:
            ValueError: a supervision, and the batch has no ``corr`` at all.
        """
        found = self(batch["first"], batch["second"]) if matched is None else matched
        with _whole_precision(batch["first"]):
            return self._terms(batch, found)

    def _terms(self, batch: Mapping[str, Any], found: Matched) -> dict[str, Tensor]:
        x, y, o = batch["first"], batch["second"], self.options
        total: dict[str, Tensor] = {}
        soft: dict[str, Any] = {}
        if o.w_align > 0 or (o.supervision != "none" and o.truth_form != "spectral"):
            masks = x["verts_mask"], y["verts_mask"]
            soft["xy"] = self.soft(found.points_x, found.points_y, *masks)
        if o.w_align > 0:
            soft["yx"] = self.soft(found.points_y, found.points_x, *reversed(masks))
        maps = found.maps
        for basis_x, basis_y, xy, yx in zip(maps.bases_x, maps.bases_y, maps.fmaps_xy, maps.fmaps_yx, strict=True):
            terms = self._usual(basis_x, basis_y, xy, yx)
            if o.w_align > 0:
                gap = alignment_energy(xy, soft["yx"], basis_x.evecs, basis_y.evecs_trans)
                gap = gap + alignment_energy(yx, soft["xy"], basis_y.evecs, basis_x.evecs_trans)
                terms["l_align"] = o.w_align * gap.mean()
            for name, value in terms.items():
                total[name] = total[name] + value if name in total else value
        if o.supervision != "none":
            total["l_truth"] = o.w_truth * self._truth(x, y, maps, soft.get("xy"))
        return total

    @torch.no_grad()
    def errors(self, batch: Mapping[str, Any], matched: Matched) -> dict[str, Float[Tensor, " B"]]:
        """Quick errors of the point maps, for each pair with a truth: :func:`torchqm.fmap.straight_errors.error_means`.

        In the order of the pairs, those without a truth left out; empty if no pair has one.
        """
        x, y = batch["first"], batch["second"]
        there = has_truth(batch)
        with _whole_precision(x):
            p2p = matched.maps.points(y["verts_mask"])
        x_corr, x_mass, x_mask = (x[name][there] for name in ("corr", "mass", "corr_mask"))
        y_corr, verts, mass, group = (y[name][there] for name in ("corr", "verts", "mass", "group"))
        errors = straight_errors(p2p[there], y_corr, x_corr, verts, mass, group)
        return error_means(errors, point_weights(y_corr, errors, x_mass, x_corr, x_mask))

    def _usual(self, basis_x: Basis, basis_y: Basis, xy: Tensor, yx: Tensor) -> dict[str, Tensor]:
        """Terms of one block; a pair with no function in it (a shape without symmetry has no odd one) counts as 0."""
        there = basis_x.mask.any(-1) & basis_y.mask.any(-1)
        given = (xy, yx, basis_x.evals, basis_y.evals, basis_x.mask, basis_y.mask)
        if bool(there.all()):
            return self.usual(*given)
        share = float(there.sum()) / len(there)
        return {name: share * value for name, value in self.usual(*(v[there] for v in given)).items()} if share else {}

    def _truth(self, x: Item, y: Item, maps: PairMaps, soft_xy: Any) -> Tensor:
        given: dict[str, Tensor]
        if self.options.truth_form == "spectral":
            made = maps.fmaps_xy[0]
            given = {"fmap_even": made}
            given |= {"evecs_even_x": maps.bases_x[0].evecs, "evecs_even_y": maps.bases_y[0].evecs}
        elif self.options.supervision == "plain":
            made, given = soft_xy, {"soft_xy": soft_xy, "group_y": y["group"][:, :1]}
        else:
            made, given = soft_xy, {"soft_xy": soft_xy, "group_y": y["group"], "group_mask": y["group_mask"]}
        there = has_truth({"first": x, "second": y})
        n_there = int(there.sum())
        if n_there == 0:
            # Still a function of the weights: a process whose batch has no truth must take part in the mean of the
            # gradients, or the others would wait for it.
            return 0.0 * made.sum()
        points = {"p2p_xy": y["corr"], "mass_x": x["mass"], "samples": x["corr"], "truth_mask": x["corr_mask"]}
        given |= points
        if n_there == len(there):
            return cast(Tensor, self.truth(**given))
        loss: Tensor = self.truth(**{name: value[there] for name, value in given.items()})
        return loss * (n_there / len(there))

    def _odd(self, feat: Tensor, item: Item, basis: Basis) -> Tensor:
        """Odd descriptors without what the odd basis does not hold, which is noise of the triangulation."""
        raw = self.odd(feat, item["faces"], item["mass"])
        return unit_mean_square(basis.evecs @ (basis.evecs_trans @ raw), item["mass"])


def has_truth(batch: Mapping[str, Any]) -> Bool[Tensor, " B"]:
    """Which pairs of a batch have a truth, at one point at least.

    Args:
        batch: pairs of :func:`torchqm.data.collate` with ``corr``.

    Raises:
        ValueError: it has no ``corr``.

    Example:
        >>> side = {"corr": torch.tensor([[3, 1], [0, 0]]), "corr_mask": torch.tensor([[True, False], [False, False]])}
        >>> has_truth({"first": side, "second": side}).tolist()
        [True, False]
    """
    x, y = batch["first"], batch["second"]
    if "corr" not in x or "corr" not in y:
        raise ValueError("corr: the pairs have none, but a supervision needs it; the data must read a truth")
    return (x["corr_mask"] & (y["corr"] >= 0)).any(-1)


def _whole_precision(item: Item) -> torch.autocast:
    """Solves, bases and losses of a mixed run: products of eigenfunctions would lose what they are there to tell."""
    return torch.autocast(item["mass"].device.type, enabled=False)
