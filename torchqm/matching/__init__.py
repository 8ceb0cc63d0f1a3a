"""Floor 5: the matchers: quotient, semi-quotient, symmetry transfer, and the pipeline that joins them."""

from torchqm.matching.candidates import FullMap, full_map_from_blocks
from torchqm.matching.collection import METHODS, SYMMETRIES, Collection
from torchqm.matching.detect import Detection, detect_group
from torchqm.matching.known import KnownSymmetry, extrinsic_symmetry, given_symmetry, no_symmetry, transferred_symmetry
from torchqm.matching.odd import OddMap, join_blocks, solve_odd
from torchqm.matching.outside import Descriptors
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.pipeline import detect_symmetry, find_symmetry, match
from torchqm.matching.prepared import match_prepared
from torchqm.matching.quotient import QuotientMatch, choose_halves, match_quotient, refine_by_icp
from torchqm.matching.result import MatchResult, SymmetryResult
from torchqm.matching.self_map import nearest_involution
from torchqm.matching.semi_quotient import SemiQuotientMatch, match_semi_quotient, pull_back
from torchqm.matching.shape import PreparedShape, prepare
from torchqm.matching.transfer import SymmetryTransfer, transfer_symmetry

__all__ = [
    "METHODS",
    "SYMMETRIES",
    "Collection",
    "Descriptors",
    "Detection",
    "FullMap",
    "KnownSymmetry",
    "MatchError",
    "MatchParameters",
    "MatchResult",
    "OddMap",
    "PreparedShape",
    "QuotientMatch",
    "SemiQuotientMatch",
    "SymmetryResult",
    "SymmetryTransfer",
    "choose_halves",
    "detect_group",
    "detect_symmetry",
    "extrinsic_symmetry",
    "find_symmetry",
    "full_map_from_blocks",
    "given_symmetry",
    "join_blocks",
    "match",
    "match_prepared",
    "match_quotient",
    "match_semi_quotient",
    "nearest_involution",
    "no_symmetry",
    "prepare",
    "pull_back",
    "refine_by_icp",
    "solve_odd",
    "transfer_symmetry",
    "transferred_symmetry",
]
