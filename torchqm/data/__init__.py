"""Shapes and pairs: the built-in creatures, the folders of benchmarks, other people's published results."""

from torchqm.data.published import (
    PUBLISHED_METHODS,
    PublishedResult,
    PublishedSummary,
    load_published,
    read_published,
    summarize_published,
)
from torchqm.data.scb import SCBenchmark, SymmetryLandmarks, shape_class
from torchqm.data.synthetic import CREATURES, Creature, ExactMaps, creature, exact_maps, symmetry_truth

__all__ = [
    "CREATURES",
    "PUBLISHED_METHODS",
    "Creature",
    "ExactMaps",
    "PublishedResult",
    "PublishedSummary",
    "SCBenchmark",
    "SymmetryLandmarks",
    "creature",
    "exact_maps",
    "load_published",
    "read_published",
    "shape_class",
    "summarize_published",
    "symmetry_truth",
]
