"""What a match gives back: all the equally good maps, their labels and scores, and everything needed to judge them."""

import json
import platform
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import p2p_to_fmap
from torchqm.geometry.files import write_whole
from torchqm.spectral.basis import SpectralBasis
from torchqm.symmetry.basis import EvenOddBasis, symmetrized_basis
from torchqm.symmetry.group import SymmetryGroup
from torchqm.version import __version__

__all__ = ["MatchResult", "SymmetryResult", "write_json", "write_npz"]


@dataclass(frozen=True, eq=False)
class MatchResult:
    """All the dense maps between two shapes.

    Args:
        maps: ``(|G|, V_source)`` int64: for each source vertex a target vertex; one row a group element.
        labels: ``direct`` (keeps orientation), ``mirrored`` (turns it over) or ``unknown``, one a row.
        scores: ``(|G|,)`` commutativity defect of each map, 0 for an isometry; lower is better.
        orbits: ``(V_source, |G|)`` int64: the target orbit of each source vertex; column g is ``maps[g]``.
        fmaps: ``(|G|, Ky, Kx)`` functional maps, functions on the source to functions on the target.
        fmap_even: ``(K+_y, K+_x)`` the map between symmetric functions, common to all the rows.
        symmetry_source: ``(|G|, V_source)`` the source's symmetry group.
        symmetry_target: ``(|G|, V_target)`` the target's.
        orientation: ``(|G|,)`` share of area that keeps orientation minus the share that turns it over.
        method: which method made it.
        warnings: assumptions that did not hold, with the numbers.
        parameters: of the method.
        seconds: per step.
        details: further numbers (residuals, origins of the symmetries).
    """

    maps: Int[Tensor, "G Vx"]
    labels: tuple[str, ...]
    scores: Float[Tensor, " G"]
    orbits: Int[Tensor, "Vx G"]
    fmaps: Float[Tensor, "G Ky Kx"]
    fmap_even: Float[Tensor, "Key Kex"]
    symmetry_source: Int[Tensor, "G Vx"]
    symmetry_target: Int[Tensor, "G Vy"]
    orientation: Float[Tensor, " G"]
    method: str
    warnings: list[str] = field(default_factory=list)
    parameters: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def direct(self) -> Int[Tensor, " Vx"] | None:
        """The map that keeps orientation, if one is labelled so."""
        return self.maps[self.labels.index("direct")] if "direct" in self.labels else None

    @property
    def mirrored(self) -> Int[Tensor, " Vx"] | None:
        """The first map that turns orientation over, if one is labelled so."""
        return self.maps[self.labels.index("mirrored")] if "mirrored" in self.labels else None

    def save(self, path: str | Path) -> Path:
        """Write everything that is an array to one ``.npz`` that loads with ``allow_pickle=False``.

        Keys: ``maps, labels, scores, orbits, fmaps, fmap_even, symmetry_source, symmetry_target, orientation``.
        """
        arrays = ("maps", "scores", "orbits", "fmaps", "fmap_even", "symmetry_source", "symmetry_target", "orientation")
        return write_npz(path, labels=np.array(self.labels), **{name: getattr(self, name).numpy() for name in arrays})

    def summary(self) -> dict[str, Any]:
        """The rest, as plain values for ``summary.json``."""
        return {
            "method": self.method,
            "maps": [
                {"label": label, "score": float(score), "orientation": float(agreement)}
                for label, score, agreement in zip(self.labels, self.scores, self.orientation, strict=True)
            ],
            **_common(self),
        }


@dataclass(frozen=True, eq=False)
class SymmetryResult:
    """The symmetry group of one shape.

    Args:
        maps: ``(|G|, V)`` int64 vertex maps, row 0 the identity.
        labels: ``direct`` or ``mirrored`` or ``unknown``, one a row.
        scores: ``(|G|,)`` commutativity defect of each map; 0 for the identity.
        basis: the K eigenfunctions of the shape, of area 1.
        origin: where it came from: ``extrinsic``, ``detected``, ``transfer`` or ``none``.
        warnings: as in :class:`MatchResult`, and so the remaining ones.
        details: of a detected symmetry ``verdict`` and the numbers behind it, see
            :class:`torchqm.matching.detect.Detection`.
    """

    maps: Int[Tensor, "G V"]
    labels: tuple[str, ...]
    scores: Float[Tensor, " G"]
    basis: SpectralBasis
    origin: str
    warnings: list[str] = field(default_factory=list)
    parameters: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str | None:
        """``symmetric``, ``ambiguous`` or ``asymmetric``; None if the spectrum was not asked, which alone can tell."""
        return self.details.get("verdict")

    @cached_property
    def fmaps(self) -> Float[Tensor, "G K K"]:
        """The functional matrix of each map, in ``basis``: ``f`` to ``f o maps[g]``."""
        return torch.stack([p2p_to_fmap(p2p, self.basis, self.basis) for p2p in self.maps])

    @cached_property
    def symmetrized(self) -> EvenOddBasis:
        """The even and odd functions: ``.even`` is a basis of L2+, ``.odd`` of its complement."""
        return symmetrized_basis(self.basis, SymmetryGroup(self.maps))

    def save(self, path: str | Path) -> Path:
        """Write ``maps, labels, scores, fmaps`` to one ``.npz`` that loads with ``allow_pickle=False``."""
        arrays = {"maps": self.maps, "scores": self.scores, "fmaps": self.fmaps}
        return write_npz(path, labels=np.array(self.labels), **{name: array.numpy() for name, array in arrays.items()})

    def summary(self) -> dict[str, Any]:
        """The rest, as plain values for ``summary.json``."""
        return {"origin": self.origin, "order": len(self.labels), "scores": self.scores.tolist(), **_common(self)}


def _common(result: MatchResult | SymmetryResult) -> dict[str, Any]:
    return {
        "warnings": result.warnings,
        "parameters": result.parameters,
        "details": result.details,
        "seconds": {name: round(value, 4) for name, value in result.seconds.items()},
        "versions": {
            "torchqm": __version__,
            "torch": torch.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "python": platform.python_version(),
        },
    }


def write_npz(path: str | Path, **arrays: np.ndarray) -> Path:
    """Write arrays to one compressed ``.npz``, whole or not at all."""
    return write_whole(path, lambda file: np.savez_compressed(file, **arrays))  # type: ignore[arg-type]


def write_json(path: str | Path, content: dict[str, Any]) -> Path:
    """Write a dictionary as indented JSON, whole or not at all; numbers that are not finite become ``null``.

    Raises:
        TypeError: a value that JSON has no type for, such as a tensor or a path.
        ValueError: a dictionary or list that holds itself.
    """
    plain = json.loads(json.dumps(content), parse_constant=lambda _: None)  # JSON has no NaN and no Infinity
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return write_whole(path, lambda file: file.write(text.encode()))
