"""Curves on inputs whose curve can be read off."""

import math

import pytest
import torch

from torchqm.evaluate.curves import area_under_curve, cumulative_curve, curve_thresholds, mean_curve


def test_curve_counts_errors_up_to_and_including_the_threshold() -> None:
    errors = torch.tensor([0.2, 0.0, 0.1, math.inf], dtype=torch.float64)
    thresholds = torch.tensor([0.0, 0.05, 0.1, 0.2, 9.0], dtype=torch.float64)
    assert cumulative_curve(errors, thresholds).tolist() == [0.25, 0.25, 0.5, 0.75, 0.75]


def test_weights_turn_shares_of_points_into_shares_of_area() -> None:
    errors, weights = torch.tensor([0.0, 0.1, 0.2]), torch.tensor([6.0, 3.0, 1.0])
    assert cumulative_curve(errors, torch.tensor([0.05, 0.15, 0.25]), weights).tolist() == pytest.approx(
        [0.6, 0.9, 1.0]
    )


def test_full_curve_ends_at_exactly_one() -> None:
    assert float(cumulative_curve(torch.rand(997), torch.tensor([1.0]))[0]) == 1.0


def test_area_is_the_integral_of_the_curve() -> None:
    errors = torch.rand(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.4
    thresholds = curve_thresholds(0.25, 100_001)
    integral = float(torch.trapezoid(cumulative_curve(errors, thresholds), thresholds)) / 0.25
    assert area_under_curve(errors) == pytest.approx(integral, abs=1e-5)


def test_area_of_perfect_hopeless_and_infinite_maps() -> None:
    assert area_under_curve(torch.zeros(3)) == pytest.approx(1.0)
    assert area_under_curve(torch.tensor([0.25, 0.7])) == 0.0
    assert area_under_curve(torch.tensor([0.0, math.inf])) == 0.5
    assert area_under_curve(torch.tensor([0.0, 1.0]), weights=torch.tensor([3.0, 1.0])) == 0.75


def test_mean_curve_counts_every_pair_alike() -> None:
    assert mean_curve([torch.tensor([0.0, 0.5]), torch.tensor([1.0, 1.0])]).tolist() == [0.5, 0.75]
    with pytest.raises(ValueError, match="one length"):
        mean_curve([torch.zeros(2), torch.zeros(3)])
    with pytest.raises(ValueError, match="one or more"):
        mean_curve([])


@pytest.mark.parametrize("errors", [[], [math.nan], [-0.1]])
def test_unusable_errors_are_refused(errors: list[float]) -> None:
    with pytest.raises(ValueError, match="errors: expected"):
        cumulative_curve(torch.tensor(errors, dtype=torch.float64), torch.tensor([0.1]))


@pytest.mark.parametrize("weights", [[0.0, 0.0], [1.0, -1.0], [math.nan, 1.0], [math.inf, 1.0]])
def test_unusable_weights_are_refused(weights: list[float]) -> None:
    with pytest.raises(ValueError, match="weights: expected 2"):
        area_under_curve(torch.zeros(2), weights=torch.tensor(weights))


def test_thresholds_hit_the_round_numbers_exactly() -> None:
    thresholds = curve_thresholds()
    assert len(thresholds) == 201
    assert float(thresholds[0]) == 0.0
    assert float(thresholds[-1]) == 0.25
    with pytest.raises(ValueError, match="upto"):
        curve_thresholds(0.0)
