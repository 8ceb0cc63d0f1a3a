"""Means over pairs: a pair counts once, flips count by points and by maps, and the solvers are named."""

import json

import pytest
import torch

from torchqm.evaluate.protocol import flip_rate, make_report
from torchqm.evaluate.summary import summarize, summarize_flips


def test_summary_counts_every_pair_once() -> None:
    reports = [
        make_report("map", torch.tensor([0.0, 0.0, 0.0, 0.0], dtype=torch.float64)),
        make_report("map", torch.tensor([0.3], dtype=torch.float64)),
    ]
    summary = summarize(reports)
    assert summary.n_pairs == 2
    assert summary.mean == summary.median == pytest.approx(0.15)
    assert summary.worst == 0.3
    assert summary.share_below == {0.05: 0.5, 0.1: 0.5, 0.25: 0.5}
    with pytest.raises(ValueError, match="one protocol"):
        summarize([*reports, make_report("plain", torch.tensor([0.3]))])
    with pytest.raises(ValueError, match="none"):
        summarize([])


def test_summaries_go_into_json() -> None:
    summary = summarize([make_report("map", torch.tensor([0.1]))])
    assert json.loads(json.dumps(summary.to_dict()))["n_pairs"] == 1


def test_a_summary_names_all_solvers_or_none() -> None:
    def report(solver: str | None):
        return make_report("map", torch.tensor([0.1]), solver=solver)

    assert summarize([report("heat"), report("heat")]).solver == "heat"
    assert summarize([report("heat"), report("fast_marching")]).solver == "fast_marching, heat"
    assert summarize([report("heat"), report(None)]).solver is None


def test_flip_rates_of_maps_and_of_points() -> None:
    direct = torch.tensor([[0.0, 0.0, 0.0, 0.4], [0.4, 0.4, 0.4, 0.0]], dtype=torch.float64)  # a quarter is mirrored
    flips = summarize_flips([flip_rate(errors) for errors in (direct, direct.flip(0), direct[:1], direct)])
    assert flips.n_pairs == 4
    assert flips.maps == 0.25
    assert flips.points == (0.25 + 0.75 + 0 + 0.25) / 4
    assert flips.patches == (0.25 + 0.25 + 0 + 0.25) / 4
    with pytest.raises(ValueError, match="one or more"):
        summarize_flips([])
