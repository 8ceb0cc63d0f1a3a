"""Other ways to match, behind one small protocol, for comparison with torchqm's own."""

from torchqm.matching.baselines.axis_curves import AxisCurves
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, Matcher
from torchqm.matching.baselines.descriptors import NearestDescriptors
from torchqm.matching.baselines.functional import FunctionalMaps, Start
from torchqm.matching.baselines.orientation import OrientationWeights, OrientRev
from torchqm.matching.baselines.ours import Ours
from torchqm.matching.baselines.pyfm import PyFM
from torchqm.matching.baselines.registry import DESCRIPTIONS, MATCHERS, get_matcher
from torchqm.matching.baselines.symmetry_factored import SymmetryFactored
from torchqm.matching.baselines.zoomout import ZoomOut

__all__ = [
    "DESCRIPTIONS",
    "MATCHERS",
    "NOTHING",
    "AxisCurves",
    "BaselineResult",
    "FunctionalMaps",
    "Given",
    "Matcher",
    "NearestDescriptors",
    "OrientRev",
    "OrientationWeights",
    "Ours",
    "PyFM",
    "Start",
    "SymmetryFactored",
    "ZoomOut",
    "get_matcher",
]
