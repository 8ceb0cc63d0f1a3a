"""torchqm.matching.baselines.base: what may be given, and that results are what they must be."""

import pickle

import pytest
import torch
from references.pairs import exact_pair

from torchqm.matching import MatchError
from torchqm.matching.baselines import NOTHING, BaselineResult, Given
from torchqm.matching.baselines.base import make_result, shared_size
from torchqm.matching.steps import Steps


@pytest.fixture(scope="module")
def pair():
    return exact_pair(2)


@pytest.mark.parametrize("name", ["symmetry_x", "symmetry_y", "side_x", "side_y", "segments_x", "segments_y"])
def test_what_is_given_must_fit_its_shape(pair, name):
    n = pair.x.n_verts
    values = {"symm": torch.zeros(2, n - 1, dtype=torch.int64), "segm": torch.zeros(n - 1, dtype=torch.int64)}
    bad = values.get(name[:4], torch.zeros(n - 1, dtype=torch.float64))
    with pytest.raises(MatchError, match=f"{name}: has 641 entries a row.*642 vertices"):
        Given(**{name: bad}).check(pair.x, pair.y)


def test_segments_need_a_partner(pair):
    some = torch.zeros(pair.x.n_verts, dtype=torch.int64)
    with pytest.raises(MatchError, match="one of the two shapes only"):
        Given(segments_x=some).check(pair.x, pair.y)
    for other in (some + 1, some - 1):
        with pytest.raises(MatchError, match="no part number in common"):
            Given(segments_x=other, segments_y=other - 1).check(pair.x, pair.y)
    assert Given(segments_x=torch.tensor([3, 1, -1, 2]), segments_y=torch.tensor([-1, 3, 2])).common_segments() == [
        2,
        3,
    ]
    assert NOTHING.common_segments() == []
    NOTHING.check(pair.x, pair.y)


def test_reflections_are_two_tables_of_two_maps(pair):
    given = Given(pair.group_x.maps, pair.group_y.maps)
    assert [t.shape[0] for t in given.reflections(pair.x, pair.y, "m")] == [2, 2]
    with pytest.raises(MatchError, match=r"m: needs symmetry_x.*none is given"):
        Given(symmetry_y=pair.group_y.maps).reflections(pair.x, pair.y, "m")
    with pytest.raises(MatchError, match=r"m: needs symmetry_y.*1 maps are given"):
        Given(pair.group_x.maps, pair.group_y.maps[:1]).reflections(pair.x, pair.y, "m")


def test_a_result_is_checked_and_adds_up_its_seconds(pair):
    steps = Steps(seconds={"a": 0.25, "b": 0.5})
    found = make_result("m", pair.x, pair.y, pair.p2p_xy, steps, notes=["said"], k=3)
    assert found.maps.shape == (1, 642)
    assert (found.seconds, found.labels, found.notes, found.details) == (0.75, ("unknown",), ["said"], {"k": 3})
    assert torch.equal(found.best, pair.p2p_xy)
    steps.seconds["a"] = 9.0
    assert found.seconds == 0.75
    again = pickle.loads(pickle.dumps(found))  # results travel between processes
    assert isinstance(again, BaselineResult)
    assert torch.equal(again.maps, found.maps)


@pytest.mark.parametrize(
    ("maps", "labels", "message"),
    [
        (torch.zeros(641, dtype=torch.int64), None, "for 642 vertices"),
        (torch.zeros(642, dtype=torch.int32), None, "int32"),
        (torch.zeros(0, 642, dtype=torch.int64), None, "m: gave"),
        (torch.full((642,), 642), None, "642..642, the target has 642"),
        (torch.full((642,), -1), None, "-1..-1"),
        (torch.zeros(2, 642, dtype=torch.int64), ("direct",), "1 labels for 2 maps"),
    ],
)
def test_a_wrong_result_is_refused(pair, maps, labels, message):
    with pytest.raises(ValueError, match=message):
        make_result("m", pair.x, pair.y, maps, Steps(), labels)


def test_shared_size(pair):
    assert shared_size(pair.x, pair.y, 100) == 60
    assert shared_size(pair.x, pair.y, 20) == 20
    with pytest.raises(MatchError, match=r"k=3: .* 60 and 60 eigenfunctions, at least 4"):
        shared_size(pair.x, pair.y, 3)
