"""The numbers of the method in one place: the paper's (section 7.4) and the ones that measured better."""

from dataclasses import asdict, dataclass, replace
from typing import Any

__all__ = ["MatchError", "MatchParameters"]


class MatchError(ValueError):
    """These shapes, symmetries and parameters do not fit each other; the message says what does not, with numbers."""


@dataclass(frozen=True)
class MatchParameters:
    """Parameters of quotient and semi-quotient matching.

    Args:
        k: eigenfunctions in which the first map is computed (the paper: 30).
        k_quotient: eigenfunctions up to which a second candidate is grown between symmetric functions alone, before
            left and right are told apart; no more than ``k`` leaves it out (the paper).
        k_max: eigenfunctions that the final refinement reaches (the paper: 300).
        descriptor: ``wks`` or ``hks``.
        n_descriptors: energies of the WKS, or times of the HKS (the paper: 100).
        splits: intervals s of the splitting (the paper: 5; 0 leaves it out).
        commutativity: weight w of the commutativity term, times the number of descriptors per basis function, with
            eigenvalues scaled to [0, 1].
        self_commutativity: the same weight for the map of a shape to itself; each gives a candidate, and the one that
            commutes best is kept (on most of the cats a weight of 1 gives half the error of 100, on coarse meshes and
            some centaurs it is the other way round).
        icp_steps: steps of (semi-)quotient ICP, at most (the paper: 20).
        icp_tolerance: relative change of the map (Frobenius norm) below which ICP stops before that.
        time: diffusion time of the deltas (1 = the area of the shape).
        n_samples: vertices, drawn by area, that stand for the surface.
        semi_width: width of the frequency mask in semi-quotient ICP; None is the iteration as printed.
        refinement: ``icp`` (the paper: ICP at k = 100 and 300), ``upsample`` (growing basis, both ways) or ``none``.
        local_weight: of local features against spectral coordinates in two-way upsampling between shapes
            (:func:`torchqm.fmap.two_way.two_way_upsample`); 0 leaves them out, also of self-maps, where they have half
            the default weight, and of the first least-squares map, where curvature is a descriptor.
        growth: ratio by which the basis grows from one step of upsampling to the next.
        seed: of the samples.
    """

    k: int = 30
    k_quotient: int = 60
    k_max: int = 200
    descriptor: str = "wks"
    n_descriptors: int = 100
    splits: int = 5
    commutativity: float = 100.0
    self_commutativity: tuple[float, ...] = (1.0, 100.0)
    icp_steps: int = 20
    icp_tolerance: float = 0.005
    time: float = 0.0
    n_samples: int = 2000
    semi_width: float | None = 0.2
    refinement: str = "upsample"
    local_weight: float = 2.0
    growth: float = 1.2
    seed: int = 0

    def __post_init__(self) -> None:
        if self.k < 4:
            raise ValueError(f"k={self.k}: at least 4 eigenfunctions are needed to tell points apart")
        if self.k_max < self.k:
            raise ValueError(f"k_max={self.k_max}: the final basis cannot be smaller than k={self.k}")
        for name, allowed in (("descriptor", ("wks", "hks")), ("refinement", ("icp", "upsample", "none"))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}={getattr(self, name)!r}: allowed are {', '.join(allowed)}")
        for name in ("n_descriptors", "n_samples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least 1")
        for name in ("splits", "icp_steps", "icp_tolerance", "commutativity", "time", "local_weight", "k_quotient"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)}: must not be negative")
        if not self.self_commutativity or min(self.self_commutativity) < 0:
            raise ValueError(
                f"self_commutativity={self.self_commutativity}: one weight or more are needed, none of them negative"
            )
        if self.descriptor == "wks" and self.n_descriptors < 2:
            raise ValueError(f"n_descriptors={self.n_descriptors}: the wave kernel signature needs at least 2 energies")
        if self.semi_width is not None and self.semi_width <= 0:
            raise ValueError(f"semi_width={self.semi_width}: must be positive, or None for the iteration as printed")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed={self.seed}: allowed are 0 to {2**63 - 1}")
        if self.growth <= 1:
            raise ValueError(f"growth={self.growth}: the basis must grow, by a ratio above 1")

    @classmethod
    def paper(cls) -> "MatchParameters":
        """Section 7.4: k = 30, WKS with 100 energies, s = 5, 20 ICP steps, then ICP at k = 100 and 300."""
        return cls(k_quotient=0, k_max=300, refinement="icp", local_weight=0.0, icp_tolerance=0.0)

    @classmethod
    def of(cls, method: str) -> "MatchParameters":
        """The parameters that belong to a method: those that measured best for ``quotient``, else the paper's."""
        return cls() if method == "quotient" else cls.paper()

    def changed(self, **values: object) -> "MatchParameters":
        """A copy with some values changed, checked again."""
        return replace(self, **values)  # type: ignore[arg-type]

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "MatchParameters":
        """The parameters that :meth:`as_dict` wrote, as a ``summary.json`` keeps them.

        Raises:
            ValueError: a name that is no parameter, or a value that is not allowed.
        """
        unknown = sorted(set(values) - set(cls.__dataclass_fields__))
        if unknown:
            raise ValueError(f"{', '.join(unknown)}: no parameter of the matching")
        plain: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
        return cls(**plain)

    def as_dict(self) -> dict[str, object]:
        """Plain values as JSON has them, for ``summary.json``."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
