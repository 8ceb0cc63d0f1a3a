"""One map measured under all protocols, on a square whose distances are known."""

import json

import pytest
import torch

from torchqm.evaluate import SurfacePoints, TruthDistances, evaluate_map
from torchqm.geometry.mesh import Mesh

# A 2 x 2 square of area 4, vertex 3 row + column; left and right swap under MIRROR.
XY = [(x, y, 0) for y in range(3) for x in range(3)]
QUADS = [(3 * r + c, 3 * r + c + 1, 3 * r + c + 4, 3 * r + c + 3) for r in range(2) for c in range(2)]
SQUARE = Mesh.from_arrays(XY, [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))], "square")
EVERY = torch.arange(9)
MIRROR = torch.stack([EVERY, torch.tensor([2, 1, 0, 5, 4, 3, 8, 7, 6])])


def test_a_mirrored_map_with_a_direct_patch() -> None:
    p2p = MIRROR[1].clone()
    p2p[:3] = EVERY[:3]  # the first row is not mirrored
    result = evaluate_map(SQUARE, p2p, EVERY, group=MIRROR, method="dijkstra")
    assert result.errors.shape == (2, 9)
    assert list(result.reports) == ["plain", "map", "orbit"]
    means = {name: report.mean for name, report in result.reports.items()}
    assert means == pytest.approx({"plain": 4 / 9, "map": 2 / 9, "orbit": 0.0})  # 1 off at four points, at two, at none
    assert result.flips is not None
    assert result.flips.points == pytest.approx(4 / 9)
    assert result.flips.map is True
    assert result.flips.patches == pytest.approx(2 / 9)


def test_the_row_is_flat_and_goes_to_json() -> None:
    row = json.loads(json.dumps(evaluate_map(SQUARE, EVERY, EVERY, group=MIRROR, method="dijkstra").to_row()))
    assert row["points"] == 9
    assert row["true_maps"] == 2
    assert row["solver"] == "dijkstra"
    assert row["map_mean"] == row["plain_median"] == row["flip_points"] == 0.0
    assert row["orbit_auc"] == pytest.approx(1.0)
    assert row["plain_below_0.05"] == pytest.approx(1.0)
    assert row["flip_map"] is False


def test_without_a_group_nothing_flips_and_protocols_agree() -> None:
    result = evaluate_map(SQUARE, EVERY.roll(1), EVERY, method="dijkstra")
    assert result.flips is None
    assert len({report.mean for report in result.reports.values()}) == 1
    assert "flip_points" not in result.to_row()


def test_a_self_map_is_measured_against_the_symmetry() -> None:
    result = evaluate_map(SQUARE, MIRROR[1], MIRROR[1], protocols=["symmetry"])
    assert result.reports["symmetry"].mean == 0.0
    wrong = evaluate_map(SQUARE, EVERY, MIRROR[1], protocols=["symmetry"], method="dijkstra")
    assert wrong.reports["symmetry"].mean == pytest.approx(6 / 9)


def test_the_solver_in_the_result_is_the_one_that_ran() -> None:
    assert evaluate_map(SQUARE, EVERY, EVERY).solver == "fast_marching"
    store = TruthDistances.build(SQUARE, EVERY, "dijkstra")
    result = evaluate_map(SQUARE, EVERY, EVERY, method="heat", distances=store)  # the rows were computed otherwise
    assert result.solver == "dijkstra"
    assert {report.solver for report in result.reports.values()} == {"dijkstra"}
    third = Mesh(SQUARE.verts, torch.cat([SQUARE.faces, torch.tensor([[0, 4, 6]])]), "third face at an edge")
    with pytest.warns(UserWarning, match="heat method is used"):
        assert evaluate_map(third, EVERY, EVERY).solver == "heat"


def test_without_rows_kept_the_numbers_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = evaluate_map(SQUARE, EVERY.roll(2), EVERY, group=MIRROR)
    monkeypatch.setattr("torchqm.evaluate.metrics.MAX_ROWS_BYTES", 0)
    streamed = evaluate_map(SQUARE, EVERY.roll(2), EVERY, group=MIRROR)
    assert torch.allclose(streamed.errors, kept.errors, rtol=1e-6)
    assert streamed.solver == kept.solver == "fast_marching"


def test_truth_inside_faces_has_images_under_the_group() -> None:
    """The point (0.5, 0) goes to (1.5, 0): a quarter and three quarters of the way along the lower edge."""
    truth = SurfacePoints(torch.tensor([[0, 1, 4]]), torch.tensor([[0.5, 0.5, 0.0]]))
    result = evaluate_map(SQUARE, torch.tensor([2]), truth, group=MIRROR, method="dijkstra")
    assert (2 * result.errors).flatten().tolist() == [1.5, 0.5]


def test_points_and_weights_are_the_callers() -> None:
    at, weights = torch.tensor([0, 8]), torch.tensor([3.0, 1.0])
    p2p = EVERY.clone()
    p2p[8] = 7
    result = evaluate_map(SQUARE, p2p, at, at, weights=weights, method="dijkstra")
    assert result.errors.tolist() == [[0.0, 0.5]]
    assert result.reports["plain"].mean == pytest.approx(0.125)


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(ValueError, match=r"group: its maps have 3 entries, square has 9 vertices"):
        evaluate_map(SQUARE, EVERY, EVERY, group=torch.tensor([[0, 1, 2]]))
    with pytest.raises(ValueError, match=r"truth: expected shape \(S,\), the group gives the images, got \(2, 9\)"):
        evaluate_map(SQUARE, EVERY, MIRROR, group=MIRROR)
    with pytest.raises(ValueError, match="'best' is unknown"):
        evaluate_map(SQUARE, EVERY, EVERY, protocols=["best"])
