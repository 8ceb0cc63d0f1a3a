"""The five bodies: where their chains run and how thick they are, varied by a seed.

Axes: x to the creature's left, y up, z forward; the biped is about 1.75 units tall and the others are of like size.
"""

from collections.abc import Callable

import numpy as np

from torchqm.data.creatures.invertebrates import asymmetric, ellipsoid, octopus
from torchqm.data.creatures.skeleton import Skeleton
from torchqm.data.creatures.vertebrates import biped, quadruped

__all__ = ["BODIES", "build_skeleton"]

BODIES: dict[str, Callable[[np.random.Generator], Skeleton]] = {
    "biped": biped,
    "quadruped": quadruped,
    "octopus": octopus,
    "ellipsoid": ellipsoid,
    "asymmetric": asymmetric,
}


def build_skeleton(kind: str, seed: int) -> Skeleton:
    """The skeleton of one individual.

    Args:
        kind: a key of :data:`BODIES`.
        seed: draws the proportions.

    Returns:
        The skeleton at rest.
    """
    return BODIES[kind](np.random.default_rng(seed))
