"""The options of the network and of its losses: plain values, so that a file can hold them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from typing import Any

from torchqm.nn.features import InputFeatures

__all__ = ["NETWORKS", "SETUPS", "SUPERVISIONS", "NetOptions", "other_architecture"]

SETUPS = ("functional_map", "quotient", "quotient+odd")
SUPERVISIONS = ("none", "orbit", "plain")
NETWORKS = ("mlp", "diffusion", "none")
_TRUTH_FORMS = ("spectral", "assignment")


@dataclass(frozen=True)
class NetOptions:
    """Everything that :class:`torchqm.learn.net.MatchNet` is made from.

    Args:
        setup: ``functional_map``, ``quotient`` or ``quotient+odd``.
        supervision: ``none``; ``orbit``, the truth up to symmetry; or ``plain``, the truth taken literally, for
            ``functional_map`` only.
        truth_form: ``spectral`` (the functional map sends deltas to deltas) or ``assignment`` (the soft map has its
            weight at the truth). Up to symmetry the spectral one needs an even block.
        inputs: names of :class:`torchqm.nn.InputFeatures`.
        signature: energies of a wave kernel signature, times of a heat kernel signature.
        k: eigenfunctions of the bases that will be given.
        network: ``mlp``, ``diffusion`` or ``none``: the input features as they are, to compare with.
        channels: of the features.
        width: channels inside the network.
        blocks: of ``diffusion``; hidden layers of ``mlp``.
        dropout: probability.
        gradients: ``diffusion``: use products of gradients.
        rotations: ``diffusion``: let them see the orientation. Then features differ left and right, and those of
            ``quotient+odd`` are no longer even.
        odd_pairs: odd descriptors, at most.
        lmbda: weight of commutativity in the solver.
        tau: temperature of the soft point maps.
        w_bij: weight of bijectivity in the loss.
        w_orth: of orthogonality.
        w_lap: of commutativity.
        w_align: of the agreement of soft and functional maps.
        w_truth: of the supervision.

    Raises:
        ValueError: an unknown word, a number out of range, or a supervision that the set-up does not have.

    Example:
        >>> NetOptions(setup="quotient", supervision="orbit").truth_form
        'spectral'
    """

    setup: str = "quotient+odd"
    supervision: str = "none"
    truth_form: str = "spectral"
    inputs: Sequence[str] = ("wks",)
    signature: int = 64
    k: int = 60
    network: str = "mlp"
    channels: int = 64
    width: int = 128
    blocks: int = 2
    dropout: float = 0.0
    gradients: bool = True
    rotations: bool = False
    odd_pairs: int = 64
    lmbda: float = 100.0
    tau: float = 0.07
    w_bij: float = 1.0
    w_orth: float = 1.0
    w_lap: float = 1e-3
    w_align: float = 1.0
    w_truth: float = 1.0

    def __post_init__(self) -> None:
        words = {"setup": SETUPS, "supervision": SUPERVISIONS, "truth_form": _TRUTH_FORMS, "network": NETWORKS}
        for name, allowed in words.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}: {getattr(self, name)!r} given, allowed are {', '.join(allowed)}")
        self._check_inputs()
        for name in ("signature", "k", "width", "blocks", "odd_pairs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: {getattr(self, name)} given, expected at least 1")
        if self.channels < 2:
            raise ValueError(f"channels: {self.channels} given, expected at least 2")
        if not self.tau > 0:
            raise ValueError(f"tau: {self.tau} given, expected a positive number")
        for name in ("lmbda", "w_align", "w_truth"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name}: {getattr(self, name)} given, expected a number from 0 on")
        if self.supervision == "plain" and self.setup != "functional_map":
            raise ValueError(f"supervision: 'plain' given for setup {self.setup!r}; it has 'orbit' and 'none'")
        if self.supervision == "orbit" and self.setup == "functional_map" and self.truth_form == "spectral":
            raise ValueError(
                "truth_form: 'spectral' given, which with supervision 'orbit' needs an even block, so setup 'quotient' "
                "or 'quotient+odd'; setup 'functional_map' has none: use truth_form 'assignment' with it"
            )
        if self.supervision == "none" and not any((self.w_bij, self.w_orth, self.w_lap, self.w_align)):
            raise ValueError("supervision: 'none' with all weights 0 leaves no loss")

    def _check_inputs(self) -> None:
        known, inputs = list(InputFeatures.KEYS), list(self.inputs)
        for name in inputs:
            if name not in known:
                near = get_close_matches(str(name), known, 1, 0.5)
                hint = f"; the nearest is {near[0]}" if near else ""
                raise ValueError(f"inputs: {name!r} given, allowed are {', '.join(known)}{hint}")
        if not inputs or len(set(inputs)) < len(inputs):
            raise ValueError(f"inputs: {inputs} given, expected at least one of {', '.join(known)}, each at most once")

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of :class:`torchqm.data.ItemOptions` that the network reads, but for ``corr``."""
        extra = ("gradients",) if self.network == "diffusion" and self.gradients else ()
        return ("mass", "basis", "group", *extra)


def other_architecture(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """The options that say what weights mean, where two sets of options differ in them; the others say how they are
    trained, and what is solved with them.

    Args:
        first: options by name; those that are missing have their default.
        second: likewise.

    Returns:
        Name, value in the first, value in the second.

    Example:
        >>> other_architecture({"width": 64, "rotations": True}, {})  # an mlp has no rotations
        [('width', 64, 128)]
    """
    one, other = ({**_DEFAULTS, **given} for given in (first, second))
    own = dict.fromkeys((*_OWN[one["network"]], *_OWN[other["network"]]))
    both = [(name, _listed(one[name]), _listed(other[name])) for name in (*_ARCHITECTURE, *own)]
    return [row for row in both if row[1] != row[2]]


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, list | tuple) else value


_ARCHITECTURE = ("network", "inputs", "signature", "k", "channels", "odd_pairs")
_OWN = {"none": (), "mlp": ("width", "blocks"), "diffusion": ("width", "blocks", "gradients", "rotations")}
_DEFAULTS = {field.name: field.default for field in fields(NetOptions)}
