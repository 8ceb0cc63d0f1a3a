"""The matchers of a comparison by name."""

from torchqm.matching.baselines.axis_curves import AxisCurves
from torchqm.matching.baselines.base import Matcher
from torchqm.matching.baselines.descriptors import NearestDescriptors
from torchqm.matching.baselines.functional import FunctionalMaps
from torchqm.matching.baselines.orientation import OrientRev
from torchqm.matching.baselines.ours import Ours
from torchqm.matching.baselines.pyfm import PyFM
from torchqm.matching.baselines.symmetry_factored import SymmetryFactored
from torchqm.matching.baselines.zoomout import ZoomOut

__all__ = ["DESCRIPTIONS", "MATCHERS", "get_matcher"]

MATCHERS: dict[str, Matcher] = {
    matcher.name: matcher
    for matcher in (
        Ours(),
        Ours(axis="reference", name="quotient-estimated-axis", needs=("reference",)),
        Ours(axis="true", name="quotient-true-axis", needs=("symmetry",)),
        Ours(method="paper", axis="known", name="paper"),
        Ours(method="semi", axis="known", name="semi"),
        FunctionalMaps(),
        ZoomOut(),
        ZoomOut(n_samples=1000, name="zoomout-fast"),
        OrientRev(),
        NearestDescriptors(),
        AxisCurves(),
        SymmetryFactored(),
        PyFM(),
    )
}
"""Each with its standard options; for other options make one yourself, under another name."""

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
"""One line for ``--help`` and tables."""


def get_matcher(name: str) -> Matcher:
    """The matcher of a name.

    Raises:
        ValueError: there is none; the names are listed.

    Example:
        >>> get_matcher("zoomout-fast").n_samples
        1000
    """
    if name not in MATCHERS:
        raise ValueError(f"method {name!r}: unknown; allowed are {', '.join(MATCHERS)}")
    return MATCHERS[name]
