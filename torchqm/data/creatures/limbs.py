"""Short ways to write chains: one chain, a left and a right one, a proportion that varies."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from torchqm.data.creatures.skeleton import Chain, Joint

__all__ = ["chain", "paired", "vary"]

_MIRROR = np.diag([-1.0, 1.0, 1.0])


def chain(
    name: str,
    nodes: Sequence[Any] | np.ndarray,
    radii: Sequence[Any] | np.ndarray,
    blend: float,
    parent: str | None = None,
    joints: Sequence[tuple[int, float]] = (),
    metric: Sequence[Any] = (1.0, 1.0, 1.0),
    orbit: str = "",
) -> Chain:
    """A chain; ``joints`` as (node, width), ``metric`` as the diagonal."""
    return Chain(
        name,
        np.array([np.asarray(p, dtype=float) for p in nodes]),
        np.asarray(radii, dtype=float),
        blend,
        parent,
        tuple(Joint(*j) for j in joints),
        np.diag(np.asarray(metric, dtype=float)),
        orbit,
    )


def paired(chains: Sequence[Chain]) -> list[Chain]:
    """Left chains (``*_l``) with their mirror images (``*_r``); parents that end in ``_l`` are mirrored as well."""
    out: list[Chain] = []
    for given in chains:
        stem = given.name.removesuffix("_l")
        left = replace(given, orbit=stem)
        parent = left.parent.removesuffix("_l") + "_r" if left.parent and left.parent.endswith("_l") else left.parent
        out += [left, left.image(_MIRROR, stem + "_r", parent)]
    return out


def vary(rng: np.random.Generator, spread: float) -> float:
    """A factor around 1 with the given relative spread, cut at twice the spread."""
    return float(np.clip(1 + spread * rng.standard_normal(), 1 - 2 * spread, 1 + 2 * spread))
