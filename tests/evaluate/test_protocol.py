"""Protocols on a hand-made map with one flipped patch, and their order."""

import json
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchqm.evaluate.protocol import (
    PROTOCOLS,
    Protocol,
    evaluate_errors,
    flip_rate,
    make_report,
)

# A map that is mirrored but for one point (column 2); column 3 lies on the axis.
MIRRORED = torch.tensor([[0.4, 0.6, 0.0, 0.01], [0.0, 0.0, 0.8, 0.01]], dtype=torch.float64)


def test_protocols_on_a_mirrored_map_with_a_direct_patch() -> None:
    reports = {name: evaluate_errors(MIRRORED, name) for name in PROTOCOLS}
    assert reports["plain"].errors.tolist() == [0.4, 0.6, 0.0, 0.01]
    assert reports["map"].errors.tolist() == [0.0, 0.0, 0.8, 0.01]
    assert reports["orbit"].errors.tolist() == [0.0, 0.0, 0.0, 0.01]
    assert reports["symmetry"].errors.tolist() == reports["plain"].errors.tolist()
    assert {name: report.element for name, report in reports.items()} == {
        "plain": 0,
        "map": 1,
        "orbit": None,
        "symmetry": 0,
    }
    assert all(report.protocol == name for name, report in reports.items())


def test_report_numbers() -> None:
    report = make_report("plain", torch.tensor([0.3, 0.0, 0.1, 0.05], dtype=torch.float64))
    assert report.mean == pytest.approx(0.1125)
    assert report.median == 0.05
    assert report.share_below == {0.05: 0.5, 0.1: 0.75, 0.25: 0.75}
    assert report.auc == pytest.approx((1 + 0.8 + 0.6 + 0) / 4)
    assert report.n_points == 4


def test_the_best_element_is_chosen_by_the_mean_not_by_the_median() -> None:
    errors = torch.tensor([[0.0, 0.0, 0.9], [0.1, 0.1, 0.1]])
    assert evaluate_errors(errors, "map").element == 1


def test_ties_go_to_the_direct_truth() -> None:
    errors = torch.tensor([[0.1, 0.2], [0.2, 0.1]])
    assert evaluate_errors(errors, "map").element == 0
    assert not flip_rate(errors).map


def test_weights_change_mean_median_and_the_chosen_element() -> None:
    errors = torch.tensor([[0.0, 1.0], [1.0, 0.2]], dtype=torch.float64)
    assert evaluate_errors(errors, "map").element == 0
    report = evaluate_errors(errors, "map", torch.tensor([1.0, 9.0]))
    assert report.element == 1
    assert report.mean == pytest.approx(0.1 * 1.0 + 0.9 * 0.2)
    assert report.median == 0.2


def test_infinite_errors_stay_visible() -> None:
    report = make_report("plain", torch.tensor([0.0, 0.0, math.inf]))
    assert report.mean == math.inf
    assert report.median == 0.0
    assert report.share_below[0.25] == pytest.approx(2 / 3)
    assert make_report("plain", torch.tensor([0.5, math.inf]), torch.tensor([1.0, 0.0])).mean == 0.5


def test_flip_rate_tells_flips_from_patches() -> None:
    rate = flip_rate(MIRRORED)
    assert (rate.points, rate.map, rate.patches) == (0.5, True, 0.25)
    direct = flip_rate(torch.tensor([[0.0, 0.0], [0.5, 0.5]]))
    assert (direct.points, direct.map, direct.patches) == (0.0, False, 0.0)


def test_flip_rate_margin_ignores_noise_near_the_axis() -> None:
    errors = torch.tensor([[0.02, 0.5, 0.0], [0.01, 0.0, 0.5]])
    assert flip_rate(errors).points == pytest.approx(2 / 3)
    assert flip_rate(errors, margin=0.05).points == pytest.approx(1 / 3)
    with pytest.raises(ValueError, match="margin"):
        flip_rate(errors, margin=-0.1)


def test_the_trivial_group_never_flips() -> None:
    rate = flip_rate(torch.tensor([[0.3, 0.4]]))
    assert (rate.points, rate.map, rate.patches) == (0.0, False, 0.0)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 8).flatmap(
        lambda g: st.integers(1, 20).flatmap(
            lambda s: st.lists(st.lists(st.floats(0, 2), min_size=s, max_size=s), min_size=g, max_size=g)
        )
    )
)
def test_forgiving_more_never_costs(rows: list[list[float]]) -> None:
    errors = torch.tensor(rows, dtype=torch.float64)
    plain, whole, orbit = (evaluate_errors(errors, name).mean for name in ("plain", "map", "orbit"))
    assert orbit <= whole + 1e-12
    assert whole <= plain + 1e-12
    assert flip_rate(errors).patches <= 1


def test_reports_go_into_json_and_rows() -> None:
    report = evaluate_errors(MIRRORED, "map", solver="heat")
    kept = json.loads(json.dumps(report.to_dict()))
    assert kept["share_below"]["0.05"] == 0.75
    assert kept["solver"] == "heat"
    row = report.to_row()
    assert list(row) == [f"map_{key}" for key in ("mean", "median", "auc", "below_0.05", "below_0.1", "below_0.25")]
    assert (row["map_mean"], row["map_below_0.25"]) == (report.mean, 0.75)


def test_the_curve_of_a_report_counts_what_its_shares_count() -> None:
    weights = torch.tensor([1.0, 2.0, 3.0, 4.0])
    report = evaluate_errors(MIRRORED, "plain", weights)
    assert report.curve(torch.tensor([0.0, 0.05, 0.25, 0.5])).tolist() == pytest.approx([0.3, 0.7, 0.7, 0.8])
    assert report.curve()[[40, 80, 200]].tolist() == pytest.approx(list(report.share_below.values()))


def test_unknown_protocol_and_empty_group_are_named() -> None:
    with pytest.raises(ValueError, match="'best' is unknown; allowed: plain, map, orbit, symmetry"):
        evaluate_errors(MIRRORED, "best")
    with pytest.raises(ValueError, match="got none"):
        evaluate_errors(torch.zeros(0, 3), "plain")
    assert evaluate_errors(MIRRORED, Protocol("mine", "least at each point", "point")).protocol == "mine"
