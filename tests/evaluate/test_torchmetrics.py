"""The torchmetrics classes: the same numbers as the functions, whatever the batches, merged metrics and processes."""

import importlib
import pickle
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("torchmetrics")
from torchmetrics import MetricCollection

from torchqm.evaluate import curve_thresholds, evaluate_errors, flip_rate, mean_curve, summarize, summarize_flips
from torchqm.evaluate.label_free import coverage, orthogonality
from torchqm.evaluate.torchmetrics import (
    AreaUnderCurve,
    CumulativeCurve,
    FlipRate,
    GeodesicError,
    MeanMeasure,
    MedianError,
    ShareBelow,
)
from torchqm.geometry.mesh import Mesh

SIZES = (7, 3, 11, 3, 5)  # points of each map


def errors_of(sizes=SIZES, seed=0) -> list[torch.Tensor]:
    """Errors of maps, each against a truth and its mirror image; the third is flipped."""
    generator = torch.Generator().manual_seed(seed)
    maps = [torch.rand(2, size, generator=generator, dtype=torch.float64) * 0.4 for size in sizes]
    direct = [errors * torch.tensor([[0.2], [1.0]]) for errors in maps]
    return [errors.flip(0) if i == 2 else errors for i, errors in enumerate(direct)]


MAPS = errors_of()
KINDS = {
    "mean": lambda **kw: GeodesicError("map", **kw),
    "median": lambda **kw: MedianError("orbit", **kw),
    "auc": lambda **kw: AreaUnderCurve("plain", upto=0.1, **kw),
    "share": lambda **kw: ShareBelow(0.05, "map", **kw),
    "curve": lambda **kw: CumulativeCurve("plain", torch.tensor([0.0, 0.1, 0.2, 0.4]), **kw),
    "flips": lambda **kw: FlipRate("points", margin=0.05, **kw),
    "flipped maps": lambda **kw: FlipRate("map", **kw),
    "patches": lambda **kw: FlipRate("patches", **kw),
}
every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())


def updated(metric, batches):
    for batch in batches:
        metric.update(batch)
    return metric


def test_values_are_those_of_the_summary() -> None:
    reports = {name: [evaluate_errors(errors, name) for errors in MAPS] for name in ("plain", "map", "orbit")}
    summary = {name: summarize(rows) for name, rows in reports.items()}
    flips = summarize_flips([flip_rate(errors, 0.05) for errors in MAPS])
    for name, expected in summary.items():
        assert updated(GeodesicError(name), MAPS).compute() == pytest.approx(expected.mean, abs=1e-15)
        assert updated(MedianError(name), MAPS).compute() == pytest.approx(expected.median, abs=1e-15)
        assert updated(AreaUnderCurve(name), MAPS).compute() == pytest.approx(expected.auc, abs=1e-15)
        for threshold, share in expected.share_below.items():
            assert updated(ShareBelow(threshold, name), MAPS).compute() == pytest.approx(share, abs=1e-15)
        curve = updated(CumulativeCurve(name), MAPS).compute()
        assert torch.allclose(curve, mean_curve([report.curve() for report in reports[name]]), atol=1e-15)
        assert len(curve) == len(curve_thresholds())
    for level, expected in (("points", flips.points), ("map", flips.maps), ("patches", flips.patches)):
        assert updated(FlipRate(level, margin=0.05), MAPS).compute() == pytest.approx(expected, abs=1e-15)
    assert flips.maps == 0.2


@every_kind
def test_one_call_batches_and_single_updates_agree(kind) -> None:
    one_by_one = updated(kind(), MAPS).compute()
    assert torch.allclose(updated(kind(), [MAPS]).compute(), one_by_one, atol=1e-15)
    assert torch.allclose(updated(kind(), [MAPS[:2], MAPS[2], MAPS[3:]]).compute(), one_by_one, atol=1e-15)
    equal = torch.stack([MAPS[1], MAPS[3]])  # (B, G, S)
    assert torch.equal(updated(kind(), [equal]).compute(), updated(kind(), list(equal)).compute())


@every_kind
def test_two_merged_metrics_are_one(kind) -> None:
    first, second = updated(kind(), MAPS[:3]), updated(kind(), MAPS[3:])
    first.merge_state(second)
    assert torch.allclose(first.compute(), updated(kind(), MAPS).compute(), atol=1e-15)


@every_kind
def test_two_processes_are_one(kind) -> None:
    """What torch.distributed does, without it: every state is gathered from both processes and reduced."""
    other = updated(kind(), MAPS[3:])
    states = [other.total, other.maps]
    gathered: list[torch.Tensor] = []

    def gather(state: torch.Tensor, group: object) -> list[torch.Tensor]:
        gathered.append(state)
        return [state, states[len(gathered) - 1]]

    here = updated(kind(dist_sync_fn=gather, distributed_available_fn=lambda: True), MAPS[:3])
    assert torch.allclose(here.compute(), updated(kind(), MAPS).compute(), atol=1e-15)
    assert [int(state) for state in gathered if not state.is_floating_point()] == [3]
    assert int(here.maps) == 3  # synchronised for the moment of computing only


@given(st.lists(st.integers(0, 2), min_size=5, max_size=5), st.integers(0, 100))
def test_any_division_of_the_maps_gives_the_same(owner: list[int], seed: int) -> None:
    maps = errors_of(seed=seed)
    parts = [GeodesicError("orbit") for _ in range(3)]
    for part, errors in zip(owner, maps, strict=True):
        parts[part].update(errors)
    whole, *others = [part for part in parts if part.update_called]
    for part in others:
        whole.merge_state(part)
    assert whole.compute() == pytest.approx(float(updated(GeodesicError("orbit"), maps).compute()), abs=1e-15)


def test_forward_gives_the_batch_and_keeps_the_whole() -> None:
    metric = GeodesicError("plain")
    assert metric(torch.tensor([0.1, 0.3])) == pytest.approx(0.2)  # (S,): the plain truth alone
    assert metric([torch.tensor([0.4]), torch.tensor([0.2, 0.2])]) == pytest.approx(0.3)
    assert metric.compute() == pytest.approx((0.2 + 0.4 + 0.2) / 3)
    metric.reset()
    metric.update(torch.tensor([0.5]))
    assert metric.compute() == 0.5


def test_weights_of_all_of_each_and_of_padding() -> None:
    errors = torch.tensor([[[0.1, 0.3]], [[0.2, 0.0]]], dtype=torch.float64)  # (B, 1, S)
    each = torch.tensor([[1.0, 1.0], [1.0, 0.0]])  # the last point of the second map is padding
    metric = GeodesicError()
    metric.update(errors, each)
    assert metric.compute() == pytest.approx(0.2)
    metric.reset()
    metric.update(errors, torch.tensor([0.0, 1.0]))
    assert metric.compute() == pytest.approx(0.15)
    metric.reset()
    metric.update([errors[0], errors[1]], [each[0], each[1]])
    assert metric.compute() == pytest.approx(0.2)


def test_a_bad_map_in_a_batch_leaves_the_metric_as_it_was() -> None:
    metric = updated(GeodesicError(), MAPS[:1])
    before = metric.total.clone()
    with pytest.raises(ValueError, match="negative or NaN"):
        metric.update([MAPS[1], torch.tensor([float("nan")])])
    assert torch.equal(metric.total, before)
    assert int(metric.maps) == 1


def test_measures_without_a_truth() -> None:
    square = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    metrics = {"coverage": MeanMeasure(coverage), "orthogonality": MeanMeasure(orthogonality)}
    for images in ([0, 1, 2], [1, 1, 1]):
        metrics["coverage"].update(square, torch.tensor(images))
    metrics["orthogonality"].update(fmap_xy=2 * torch.eye(2))
    assert metrics["coverage"].compute() == pytest.approx((1 + 1 / 3) / 2)
    assert metrics["orthogonality"].compute() == 9.0


def test_they_live_in_collections_and_pickles() -> None:
    metrics = MetricCollection({"error": GeodesicError("map"), "flips": FlipRate("map")})
    for errors in MAPS:
        metrics.update(errors)
    values = pickle.loads(pickle.dumps(metrics)).compute()
    assert values["flips"] == pytest.approx(0.2)
    assert values["error"] == pytest.approx(float(updated(GeodesicError("map"), MAPS).compute()), abs=1e-15)


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(ValueError, match="'best' is unknown; allowed: plain, map, orbit, symmetry"):
        GeodesicError("best")
    with pytest.raises(ValueError, match="level: 'maps' is unknown"):
        FlipRate("maps")
    with pytest.raises(ValueError, match="margin"):
        FlipRate(margin=-1.0)
    with pytest.raises(ValueError, match="upto"):
        AreaUnderCurve(upto=0.0)
    with pytest.raises(ValueError, match=r"errors: expected shape .* got \(1, 1, 1, 1\)"):
        GeodesicError().update(torch.zeros(1, 1, 1, 1))
    with pytest.raises(ValueError, match="weights: expected one row for each of the 5 maps, got 1"):
        GeodesicError().update(MAPS, [torch.ones(7)])


def test_without_the_package_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    monkeypatch.delitem(sys.modules, "torchqm.evaluate.torchmetrics")
    with pytest.raises(ImportError, match=r"pip install 'torchqm\[torchmetrics\]'"):
        importlib.import_module("torchqm.evaluate.torchmetrics")
