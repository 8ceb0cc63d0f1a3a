"""The matchers of a comparison by name."""

from torchqm.catalogue import DESCRIPTIONS
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
