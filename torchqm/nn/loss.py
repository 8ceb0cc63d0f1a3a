"""Losses that know about symmetry, and the usual ones of functional maps, as layers."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchqm.fmap.fmap_losses import surfmnet_losses
from torchqm.fmap.orbit_consistency import orbit_consistency_fmap, orbit_consistency_points
from torchqm.fmap.orbit_loss import (
    assignment_orbit_loss,
    distance_orbit_loss,
    map_orbit_loss,
    spectral_orbit_loss,
)
from torchqm.fmap.orbit_terms import require_eps
from torchqm.fmap.orbit_truth import require_temperature
from torchqm.options import require_choice, require_flag, require_number

__all__ = ["FunctionalMapLoss", "OrbitConsistencyLoss", "PointToOrbitLoss"]

REDUCTIONS = ("mean", "none")
SURFMNET_NAMES = ("C12", "C21", "evals_1", "evals_2", "evals_mask_1", "evals_mask_2")
CONSISTENCIES: dict[str, Callable[..., Tensor]] = {"fmap": orbit_consistency_fmap, "points": orbit_consistency_points}


class _Form(NamedTuple):
    """A form of the orbit loss: its function, what it needs, what it takes besides, and its options."""

    function: Callable[..., Tensor]
    needed: tuple[str, ...]
    allowed: tuple[str, ...]
    options: tuple[str, ...]


FORMS = {
    "spectral": _Form(spectral_orbit_loss, ("fmap_even", "evecs_even_x", "evecs_even_y"), (), ()),
    "assignment": _Form(assignment_orbit_loss, ("soft_xy", "group_y"), ("group_mask",), ("log_weights", "eps")),
    "distance": _Form(distance_orbit_loss, ("soft_xy",), ("group_y", "dist_y", "orbit_dist", "group_mask"), ()),
    "map": _Form(
        map_orbit_loss, ("soft_xy", "group_y"), ("dist_y", "group_mask"), ("temperature", "log_weights", "eps")
    ),
}

OPTIONS: dict[str, Callable[[Any], None]] = {
    "eps": require_eps,
    "log_weights": partial(require_flag, "log_weights"),
    "temperature": require_temperature,
}


class PointToOrbitLoss(nn.Module):
    """Supervision up to symmetry: any of the equally good answers costs the same. T is the truth, ``a_x`` are areas.

    * ``spectral``: ``sum_x a_x || C phi+_x - phi+_T(x) ||^2``, C the map of even functions;
    * ``assignment``: ``-sum_x a_x log sum_{y in orbit(T(x))} Pi(x, y)``;
    * ``distance``: ``sum_x a_x sum_y Pi(x, y) d(y, orbit(T(x)))^2``;
    * ``map``: ``-t log mean_g exp(-L_g / t)`` with ``L_g`` the loss against ``g o T``: without ``dist_y``
      ``-sum_x a_x log Pi(x, g(T(x)))``, with it ``sum_x a_x sum_y Pi(x, y) d(y, g(T(x)))^2``.

    The first three choose a member of the orbit for each point, the last one an element for the whole map.

    Args:
        form: which of the four.
        reduction: ``mean`` over the shapes of the batch, or ``none``: ``(B,)``. Over points the mean is always by area.
        **options: ``log_weights`` and ``eps`` of :func:`~torchqm.fmap.orbit_loss.assignment_orbit_loss`;
            ``temperature``, ``log_weights`` and ``eps`` of :func:`~torchqm.fmap.orbit_loss.map_orbit_loss`.

    Raises:
        ValueError: unknown ``form`` or ``reduction``, an option that the form does not have, or one out of range.

    Example:
        >>> import torch
        >>> loss = PointToOrbitLoss("assignment")
        >>> mirror = torch.tensor([[[0, 1, 2], [2, 1, 0]]])
        >>> flipped = torch.eye(3).flip(0)[None]
        >>> loss(torch.tensor([[0, 1, 2]]), soft_xy=flipped, group_y=mirror).item()
        0.0
    """

    def __init__(self, form: str = "assignment", reduction: str = "mean", **options: Any) -> None:
        super().__init__()
        require_choice("form", form, FORMS)
        require_choice("reduction", reduction, REDUCTIONS)
        known = FORMS[form].options
        for name in options:
            if name not in known:
                raise ValueError(f"{name}: the form {form!r} has no such option; it has {', '.join(known) or 'none'}")
            OPTIONS[name](options[name])
        self.form, self.reduction, self.options = form, reduction, options

    def forward(
        self,
        p2p_xy: Int[Tensor, "*B N"],
        mass_x: Float[Tensor, "*B X"] | None = None,
        samples: Int[Tensor, "*B N"] | None = None,
        truth_mask: Bool[Tensor, "*B N"] | None = None,
        **given: Any,
    ) -> Float[Tensor, "..."]:
        """The loss.

        Args:
            p2p_xy: ``(B, N)`` for points of x their true vertices of y; -1: no truth.
            mass_x: ``(B, X)`` vertex areas of x; points are weighted by them. Padding must have area 0.
            samples: ``(B, N)`` which vertices of x the points are; all in order if not given.
            truth_mask: ``(B, N)`` false: no truth (``corr_mask`` of a padded batch).
            **given: by name, what the form needs: ``fmap_even (B, Ky, Kx)``, ``evecs_even_x (B, X, Kx)`` and
                ``evecs_even_y (B, Y, Ky)`` (spectral); ``soft_xy`` and ``group_y (B, G, Y)`` with ``group_mask (B, G)``
                (the others); ``dist_y (B, Y, Y)``, or ``orbit_dist (B, N, Y)`` without a group (distance; ``dist_y``
                also map).

        Raises:
            ValueError: something is missing, not of this form, or does not fit.
        """
        function, needed, allowed, _ = FORMS[self.form]
        for name in needed:
            if given.get(name) is None:
                raise ValueError(f"{name}: not given, but the form {self.form!r} needs it")
        for name in given:
            if name not in needed + allowed:
                raise ValueError(f"{name}: given, but the form {self.form!r} takes {', '.join(needed + allowed)}")
        loss = function(p2p_xy=p2p_xy, mass_x=mass_x, samples=samples, truth_mask=truth_mask, **given, **self.options)
        return _reduced(loss, self.reduction, "p2p_xy")

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        shown = {"form": self.form, "reduction": self.reduction, **self.options}
        return ", ".join(f"{name}={value}" for name, value in shown.items())


class FunctionalMapLoss(nn.Module):
    """Bijectivity, orthogonality and Laplacian commutativity: call and result of ULRSSM's ``SURFMNetLoss``.

    ``C12`` takes functions on shape 1 to functions on shape 2. Each is a mean over the batch, times its weight:

    * ``l_bij``: ``|| C12 C21 - I ||^2 + || C21 C12 - I ||^2``;
    * ``l_orth``: ``|| C12^T C12 - I ||^2 + || C21^T C21 - I ||^2``;
    * ``l_lap``: ``|| C12 Delta_1 - Delta_2 C12 ||^2 + || C21 Delta_2 - Delta_1 C21 ||^2``.

    Rectangular maps, which that class does not take: orthogonality is over the smaller side, and of the bijectivity its
    least possible value ``|K1 - K2|`` is taken off.

    Args:
        w_bij: weight of bijectivity, not negative; a loss with weight 0 is left out of the result.
        w_orth: weight of orthogonality.
        w_lap: weight of commutativity.

    Raises:
        ValueError: a weight is negative.

    Example:
        >>> import torch
        >>> evals, eye = torch.tensor([[0.0, 1.0]]), torch.eye(2)[None]
        >>> {name: loss.item() for name, loss in FunctionalMapLoss(w_lap=0)(eye, 2 * eye, evals, evals).items()}
        {'l_bij': 4.0, 'l_orth': 18.0}

    References:
        :func:`torchqm.fmap.fmap_losses.surfmnet_losses`.
    """

    def __init__(self, w_bij: float = 1.0, w_orth: float = 1.0, w_lap: float = 1e-3) -> None:
        super().__init__()
        for name, weight in (("w_bij", w_bij), ("w_orth", w_orth), ("w_lap", w_lap)):
            require_number(name, weight, least=0)
        self.w_bij, self.w_orth, self.w_lap = w_bij, w_orth, w_lap

    def forward(
        self,
        C12: Float[Tensor, "*B K2 K1"],
        C21: Float[Tensor, "*B K1 K2"],
        evals_1: Float[Tensor, "*B K1"],
        evals_2: Float[Tensor, "*B K2"],
        evals_mask_1: Bool[Tensor, "*B K1"] | None = None,
        evals_mask_2: Bool[Tensor, "*B K2"] | None = None,
    ) -> dict[str, Float[Tensor, ""]]:
        """The weighted losses.

        Args:
            C12: ``(B, K2, K1)`` takes functions on 1 to functions on 2.
            C21: ``(B, K1, K2)`` takes functions on 2 to functions on 1.
            evals_1: ``(B, K1)`` eigenvalues of 1.
            evals_2: ``(B, K2)`` eigenvalues of 2.
            evals_mask_1: ``(B, K1)`` real functions of 1.
            evals_mask_2: ``(B, K2)`` real functions of 2.
        """
        found = surfmnet_losses(C12, C21, evals_1, evals_2, evals_mask_1, evals_mask_2, SURFMNET_NAMES)
        weights = {"l_bij": self.w_bij, "l_orth": self.w_orth, "l_lap": self.w_lap}
        return {name: weight * _reduced(found[name], "mean", "C12") for name, weight in weights.items() if weight > 0}

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        return f"w_bij={self.w_bij}, w_orth={self.w_orth}, w_lap={self.w_lap}"


class OrbitConsistencyLoss(nn.Module):
    """A map must carry the symmetries of x to those of y; needs no truth.

    * ``fmap``: ``mean_g || C S_x^g - S_y^g C ||^2``, all of them functional maps, C from x to y
      (:func:`torchqm.fmap.orbit_consistency.orbit_consistency_fmap`);
    * ``points``: ``mean_g sum_x a_x || (Pi f)(g_x(x)) - (Pi (f o g_y))(x) ||^2``, Pi from x to y
      (:func:`torchqm.fmap.orbit_consistency.orbit_consistency_points`).

    Args:
        form: ``fmap`` or ``points``.
        reduction: ``mean`` over the batch, or ``none``: ``(B,)``.
        temperature: of the minimum over ``pairings``; 0: the minimum itself.

    Raises:
        ValueError: unknown ``form`` or ``reduction``, or a negative or infinite ``temperature``.

    Example:
        >>> import torch
        >>> flip = torch.stack([torch.eye(2), torch.diag(torch.tensor([1.0, -1.0]))])[None]
        >>> OrbitConsistencyLoss()(torch.eye(2)[None], flip, flip).item()
        0.0
    """

    def __init__(self, form: str = "fmap", reduction: str = "mean", temperature: float = 0.0) -> None:
        super().__init__()
        require_choice("form", form, CONSISTENCIES)
        require_choice("reduction", reduction, REDUCTIONS)
        require_temperature(temperature)
        self.form, self.reduction, self.temperature = form, reduction, temperature

    def forward(self, map_xy: Any, symmetry_x: Tensor, symmetry_y: Tensor, **given: Any) -> Float[Tensor, "..."]:
        """The loss.

        Args:
            map_xy: ``(B, Ky, Kx)`` functional map, or soft point map (dense ``(B, X, Y)`` or sparse).
            symmetry_x: of x: ``(B, G, Kx, Kx)`` functional maps, or ``(B, G, X)`` vertex maps.
            symmetry_y: of y, in corresponding order.
            **given: by name: ``group_mask (B, G)``, ``pairings (A, G)``; for points ``values_y (B, Y, C)`` and
                ``mass_x (B, X)``.
        """
        given |= {"temperature": self.temperature, "names": ("map_xy", "symmetry_x", "symmetry_y")}
        return _reduced(CONSISTENCIES[self.form](map_xy, symmetry_x, symmetry_y, **given), self.reduction, "map_xy")

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        return f"form={self.form}, reduction={self.reduction}, temperature={self.temperature}"


def _reduced(loss: Tensor, reduction: str, name: str) -> Tensor:
    if reduction == "none":
        return loss
    if not loss.numel():
        raise ValueError(f"{name}: an empty batch given, which has no mean; at least one shape is needed")
    return loss.mean()
