import json

import pytest

from torchqm.matching import MatchParameters


def test_the_papers_numbers():
    """Section 7.4."""
    paper = MatchParameters.paper()
    assert (paper.k, paper.descriptor, paper.n_descriptors, paper.splits, paper.icp_steps) == (30, "wks", 100, 5, 20)
    assert (paper.k_max, paper.refinement) == (300, "icp")


def test_changed_is_a_checked_copy():
    first = MatchParameters()
    second = first.changed(k=40, refinement="none")
    assert (second.k, second.refinement, second.k_max) == (40, "none", first.k_max)
    assert (first.k, first.refinement) == (30, "upsample")
    with pytest.raises(ValueError, match="k_max=20"):
        first.changed(k_max=20)
    with pytest.raises(TypeError):
        first.changed(nonsense=1)


def test_plain_values():
    values = MatchParameters(semi_width=None).as_dict()
    assert json.loads(json.dumps(values)) == values
    assert MatchParameters.from_dict(json.loads(json.dumps(values))) == MatchParameters(semi_width=None)
    with pytest.raises(ValueError, match="k_min: no parameter"):
        MatchParameters.from_dict({"k_min": 3})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"k": 3}, "k=3: at least 4"),
        ({"k": 50, "k_max": 40}, "k_max=40: .* smaller than k=50"),
        ({"descriptor": "shot"}, "descriptor='shot': allowed are wks, hks"),
        ({"refinement": "zoomout"}, "refinement='zoomout': allowed are icp, upsample, none"),
        ({"n_descriptors": 0}, "n_descriptors=0"),
        ({"n_samples": 0}, "n_samples=0"),
        ({"splits": -1}, "splits=-1"),
        ({"icp_steps": -1}, "icp_steps=-1"),
        ({"icp_tolerance": -0.1}, "icp_tolerance=-0.1"),
        ({"commutativity": -0.5}, "commutativity=-0.5"),
        ({"self_commutativity": (1.0, -2.0)}, r"self_commutativity=\(1.0, -2.0\): one weight or more"),
        ({"self_commutativity": ()}, "self_commutativity=.*: one weight or more"),
        ({"time": -1e-9}, "time=-1e-09"),
        ({"growth": 1.0}, "growth=1.0"),
        ({"seed": -1}, "seed=-1"),
        ({"seed": 10**20}, "seed=100000000000000000000: allowed are 0 to"),
    ],
    ids=str,
)
def test_refusals(values, message):
    with pytest.raises(ValueError, match=message):
        MatchParameters(**values)


@pytest.mark.parametrize("values", [{"k": 4, "k_max": 4}, {"splits": 0}, {"icp_steps": 0}, {"commutativity": 0.0}])
def test_limits_are_allowed(values):
    assert {name: getattr(MatchParameters(**values), name) for name in values} == values
