"""Shapes and pairs: the built-in creatures, the folders of benchmarks, other people's published results."""

from torchqm.data.base import LayoutError, Problem, ShapeSet, Truth, TruthError
from torchqm.data.collate import collate
from torchqm.data.dataset import PairDataset, ShapeDataset
from torchqm.data.items import ItemOptions, make_item
from torchqm.data.layouts import LAYOUTS, open_shapes
from torchqm.data.pairs import choose_pairs
from torchqm.data.published import PUBLISHED_METHODS, PublishedResult, load_published, read_published
from torchqm.data.published_means import PublishedSummary, published_summary, summarize_published
from torchqm.data.scb import SCBenchmark, SymmetryLandmarks, shape_class
from torchqm.data.splits import Split, SplitError, draw_split, own_split, read_split_file, write_split_file
from torchqm.data.synthetic import CREATURES, Creature, ExactMaps, creature, exact_maps, symmetry_truth
from torchqm.data.synthetic_set import SyntheticShapes

__all__ = [
    "CREATURES",
    "LAYOUTS",
    "PUBLISHED_METHODS",
    "Creature",
    "ExactMaps",
    "ItemOptions",
    "LayoutError",
    "PairDataset",
    "Problem",
    "PublishedResult",
    "PublishedSummary",
    "SCBenchmark",
    "ShapeDataset",
    "ShapeSet",
    "Split",
    "SplitError",
    "SymmetryLandmarks",
    "SyntheticShapes",
    "Truth",
    "TruthError",
    "choose_pairs",
    "collate",
    "creature",
    "draw_split",
    "exact_maps",
    "load_published",
    "make_item",
    "open_shapes",
    "own_split",
    "published_summary",
    "read_published",
    "read_split_file",
    "shape_class",
    "summarize_published",
    "symmetry_truth",
    "write_split_file",
]
