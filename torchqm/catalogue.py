"""What there is to choose from, in words: here, so that ``--help`` can say it without loading the torch behind it."""

__all__ = ["DESCRIPTIONS", "PAIRS_HELP", "PUBLISHED_METHODS"]

DESCRIPTIONS: dict[str, str] = {
    "quotient": "torchqm, automatic: symmetries from the two shapes alone",
    "quotient-estimated-axis": "torchqm, symmetries by transfer from an undeformed pose",
    "quotient-true-axis": "torchqm, symmetries given",
    "paper": "quotient spaces as published (SGP 2013); undeformed pose used if there is one",
    "semi": "semi-quotient matching alone (SGP 2013, section 5)",
    "fmap": "functional maps: descriptors, commutativity, ICP (SIGGRAPH 2012)",
    "zoomout": "ZoomOut from the start of fmap (SIGGRAPH Asia 2019)",
    "zoomout-fast": "ZoomOut on 1000 farthest points",
    "orient-rev": "self-symmetry: orientation-reversing functional map (SIGGRAPH Asia 2018), then ZoomOut",
    "descriptors": "nearest wave kernel signatures",
    "axis-curves": "symmetry axis curves, true axis given (SGP 2012)",
    "symmetry-factored": "quotient matching with L2+ from a symmetry-factored embedding (SIGGRAPH 2010)",
    "pyfm": "pyFM 1.3: fit and ZoomOut on 3000 points",
}
"""The methods of :data:`torchqm.matching.baselines.MATCHERS`, a line each."""

PUBLISHED_METHODS = {
    "BlendedMap": "Blended intrinsic maps (BIM)",
    "LipmanGMDS": "Moebius voting",
    "BestConf": "Best conformal map",
    "BronsteinGMDS": "GMDS",
    "Ovsjanikov1": "Heat kernel map, one correspondence (HKM)",
    "Ovsjanikov2": "Heat kernel map, two correspondences (HKM-2)",
}
"""Method names in the file names, and what they stand for."""

PAIRS_HELP = (
    "all (ordered pairs), unordered, within-class, within-class+unordered, published (scb), or a file with two names a "
    "line; '+self' adds each shape with itself"
)
"""What :func:`torchqm.data.choose_pairs` understands, in a line for ``--help``."""
