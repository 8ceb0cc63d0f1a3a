"""Geodesic errors on a flat square, where every distance is known, and the store of distance rows."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import torchqm.geometry.geodesic
from torchqm.evaluate.metrics import SurfacePoints, TruthDistances, geodesic_errors, group_truth, spread_points
from torchqm.evaluate.protocol import evaluate_errors
from torchqm.geometry.mesh import Mesh

# A 2 x 2 square of area 4 (so sqrt(area) is 2): 9 vertices, id = 3 row + column.
XY = [(x, y) for y in range(3) for x in range(3)]
QUADS = [(3 * r + c, 3 * r + c + 1, 3 * r + c + 4, 3 * r + c + 3) for r in range(2) for c in range(2)]
FACES = [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]
MIRROR = torch.tensor([[0, 1, 2, 3, 4, 5, 6, 7, 8], [2, 1, 0, 5, 4, 3, 8, 7, 6]])


@pytest.fixture
def square() -> Mesh:
    return Mesh.from_arrays([(x, y, 0) for x, y in XY], FACES, name="square")


def test_errors_are_distances_over_sqrt_area(square: Mesh) -> None:
    p2p = torch.tensor([0, 1, 2, 3, 4, 5, 6, 7, 7])  # vertex 8 goes to its neighbour
    errors = geodesic_errors(square, p2p, torch.arange(9), method="dijkstra")
    assert errors.dtype == torch.float64
    assert errors.tolist() == [0.0] * 8 + [0.5]


def test_errors_at_chosen_points_of_another_shape(square: Mesh) -> None:
    """The source has its own number of vertices; the truth is listed in the order of the points."""
    p2p = torch.tensor([2, 0, 5, 1])
    errors = geodesic_errors(square, p2p, torch.tensor([1, 0]), at=torch.tensor([3, 0]), method="dijkstra")
    assert errors.tolist() == [0.0, 1.0]


def test_the_scale_of_the_target_does_not_matter(square: Mesh) -> None:
    p2p, truth = torch.tensor([4, 8, 6]), torch.tensor([0, 0, 8])
    large = square.moved(square.verts * 1e3)
    assert torch.allclose(geodesic_errors(square, p2p, truth), geodesic_errors(large, p2p, truth), rtol=1e-6)


def test_a_mirrored_map_is_right_under_the_group(square: Mesh) -> None:
    truth = group_truth(torch.arange(9), MIRROR)
    assert truth.shape == (2, 9)
    errors = geodesic_errors(square, MIRROR[1], truth, method="dijkstra")
    assert errors[0].tolist() == [1.0, 0.0, 1.0] * 3
    assert evaluate_errors(errors, "map").mean == evaluate_errors(errors, "orbit").mean == 0.0
    assert evaluate_errors(errors, "plain").mean == pytest.approx(2 / 3)


def test_group_truth_checks_its_input() -> None:
    with pytest.raises(ValueError, match="row 0 must be the identity"):
        group_truth(torch.tensor([0]), MIRROR.flip(0))
    with pytest.raises(ValueError, match=r"must lie in 0\.\.8, got 0\.\.9"):
        group_truth(torch.tensor([0, 9]), MIRROR)


def test_only_the_rows_of_the_true_points_are_computed(square: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = count_calls(monkeypatch)
    store = TruthDistances.build(square, torch.tensor([[8, 0, 8], [6, 2, 6]]), "dijkstra")
    assert asked == [[0, 2, 6, 8]]
    assert store.rows.shape == (4, 9)
    assert store.rows.dtype == torch.float32
    errors = [
        geodesic_errors(square, p2p, torch.tensor([8, 0]), distances=store)
        for p2p in (torch.tensor([8, 0]), torch.tensor([5, 0]))
    ]
    assert [row.tolist() for row in errors] == [[0.0, 0.0], [0.5, 0.0]]
    assert len(asked) == 1


def test_rows_are_computed_in_chunks(square: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = TruthDistances.build(square, torch.arange(9))
    asked = count_calls(monkeypatch)
    monkeypatch.setattr("torchqm.evaluate.distances._CHUNK_BYTES", 4 * 8 * 9)
    assert torch.equal(TruthDistances.build(square, torch.arange(9)).rows, whole.rows)
    assert asked == [[0, 1, 2, 3], [4, 5, 6, 7], [8]]


def test_a_truth_at_all_vertices_keeps_no_rows(square: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    p2p = torch.tensor([4, 1, 0, 3, 8, 5, 2, 7, 6])
    kept = geodesic_errors(square, p2p, group_truth(torch.arange(9), MIRROR))
    inside = SurfacePoints(square.faces[[0, 3, 5]], torch.tensor([[0.2, 0.3, 0.5]]).repeat(3, 1))
    kept_inside = geodesic_errors(square, p2p, inside, at=torch.tensor([0, 4, 8]))
    asked = count_calls(monkeypatch)
    monkeypatch.setattr("torchqm.evaluate.metrics.MAX_ROWS_BYTES", 4 * 2 * 9)  # of two vertices
    monkeypatch.setattr("torchqm.evaluate.distances._CHUNK_BYTES", 3 * 8 * 9)
    streamed = geodesic_errors(square, p2p, group_truth(torch.arange(9), MIRROR))
    assert torch.allclose(streamed, kept, rtol=1e-6, atol=0)
    assert max(len(sources) for sources in asked) == 3
    assert sorted(v for sources in asked for v in sources) == [0, 2, 3, 4, 5, 6, 8]  # 1 and 7 went where they should
    assert torch.allclose(geodesic_errors(square, p2p, inside, at=torch.tensor([0, 4, 8])), kept_inside, rtol=1e-6)
    with pytest.raises(ValueError, match=r"9 true vertices of square take .* GiB.*spread_points"):
        TruthDistances.build(square, torch.arange(9))
    assert TruthDistances.build(square, torch.arange(2)).rows.shape == (2, 9)


def test_fifty_two_thousand_vertices_do_not_fit_as_a_matrix(square: Mesh) -> None:
    """What TOSCA's largest meshes may keep, without making any of it."""
    large = Mesh(torch.zeros(52_565, 3, dtype=torch.float64), square.faces, "david")
    assert not TruthDistances.fits(large, torch.arange(52_565))
    assert TruthDistances.fits(large, torch.arange(2 * 1024))


def test_a_distance_matrix_at_hand_is_taken_as_it_is(square: Mesh) -> None:
    matrix = torch.rand(9, 9, generator=torch.Generator().manual_seed(0))
    given = TruthDistances(square, torch.arange(9), matrix, square.area**0.5, "given")
    truth = torch.tensor([3, 3, 8])
    errors = geodesic_errors(square, torch.tensor([5, 3, 0]), truth, distances=given)
    assert torch.equal(errors, matrix[truth, torch.tensor([5, 3, 0])].double() / 2)


def test_points_inside_faces_have_images_under_a_group(square: Mesh) -> None:
    bary = torch.tensor([[0.5, 0.25, 0.25], [1.0, 0.0, 0.0]])
    images = group_truth(SurfacePoints(square.faces[:2], bary), MIRROR)
    assert isinstance(images, SurfacePoints)
    positions = (square.verts[images.corners] * images.bary[..., None]).sum(-2)
    assert torch.equal(positions[1], positions[0] * torch.tensor([-1.0, 1, 1]) + torch.tensor([2.0, 0, 0]))
    assert torch.equal(images.corners[0], square.faces[:2])
    assert torch.equal(images.bary, bary.repeat(2, 1, 1))


def test_truth_inside_a_face(square: Mesh) -> None:
    """Face 0 is the triangle (0,0), (1,0), (1,1). Its point (0.75, 0.25) has barycentric weights (1/4, 1/2, 1/4)."""
    truth = SurfacePoints.from_faces(square, torch.tensor([0, 0, 0]), torch.tensor([[0.25, 0.5, 0.25]]).repeat(3, 1))
    predicted = torch.tensor([0, 1, 5])
    errors = geodesic_errors(square, predicted, truth, method="exact" if has_exact() else "fast_marching") * 2
    near = [math.hypot(0.75, 0.25), math.hypot(0.25, 0.25)]
    assert errors[:2].tolist() == pytest.approx(near, abs=1e-6)  # corners of the true face: exact
    true_far = math.hypot(2 - 0.75, 1 - 0.25)
    assert true_far - 1e-6 <= float(errors[2]) <= 1.1 * true_far  # elsewhere: an upper bound, close


def test_truth_at_a_corner_of_a_face_equals_truth_at_the_vertex(square: Mesh) -> None:
    predicted = torch.arange(9)
    as_point = SurfacePoints(torch.tensor([[0, 1, 4]]).repeat(9, 1), torch.tensor([[0.0, 1.0, 0.0]]).repeat(9, 1))
    errors = geodesic_errors(square, predicted, as_point)
    assert torch.equal(errors, geodesic_errors(square, predicted, torch.ones(9, dtype=torch.int64)))


def test_truth_inside_faces_takes_a_group(square: Mesh) -> None:
    bary = torch.tensor([[[0.5, 0.5, 0.0]], [[1.0, 0.0, 0.0]]])
    truth = SurfacePoints(torch.tensor([[[0, 1, 4]], [[2, 1, 4]]]), bary)
    errors = geodesic_errors(square, torch.tensor([2]), truth, method="dijkstra")
    assert errors.tolist() == [[0.75], [0.0]]


def test_components_are_infinitely_far_apart() -> None:
    two = Mesh.from_arrays(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]], [[0, 1, 2], [3, 4, 5]], name="two"
    )
    assert geodesic_errors(two, torch.tensor([4]), torch.tensor([0])).tolist() == [math.inf]
    flat = SurfacePoints(torch.tensor([[0, 1, 2]]), torch.tensor([[1.0, 0.0, 0.0]]))
    assert geodesic_errors(two, torch.tensor([4]), flat).tolist() == [math.inf]


def test_cache_is_used_and_keyed_by_content(square: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = count_calls(monkeypatch)
    truth = torch.tensor([3, 5])
    first = TruthDistances.build(square, truth, "dijkstra", tmp_path / "cache")
    again = TruthDistances.build(
        Mesh(square.verts.clone(), square.faces, "other name"), truth, "dijkstra", tmp_path / "cache"
    )
    assert torch.equal(first.rows, again.rows)
    assert len(asked) == 1
    assert [path.suffix for path in (tmp_path / "cache").iterdir()] == [".npz"]
    TruthDistances.build(square, truth, "fast_marching", tmp_path / "cache")
    TruthDistances.build(square, torch.tensor([3]), "dijkstra", tmp_path / "cache")
    TruthDistances.build(square.moved(square.verts * 2), truth, "dijkstra", tmp_path / "cache")
    assert len(asked) == len(list((tmp_path / "cache").iterdir())) == 4


@pytest.mark.parametrize("damage", ["truncated", "foreign", "no zip"])
def test_a_damaged_cache_entry_is_rebuilt_and_reported(square: Mesh, tmp_path: Path, damage: str) -> None:
    truth = torch.tensor([3, 5])
    rows = TruthDistances.build(square, truth, "dijkstra", tmp_path).rows
    (path,) = tmp_path.iterdir()
    if damage == "foreign":
        np.savez(path, rows=np.zeros((2, 8), np.float32), sources=truth.numpy())
    else:
        path.write_bytes(path.read_bytes()[:-40] if damage == "truncated" else b"hello")
    with pytest.warns(UserWarning, match="damaged or foreign cache entry"):
        assert torch.equal(TruthDistances.build(square, truth, "dijkstra", tmp_path).rows, rows)
    assert torch.equal(TruthDistances.build(square, truth, "dijkstra", tmp_path).rows, rows)


def test_a_failed_write_leaves_nothing_behind(square: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(*_: object, **__: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(OSError, match="no space"):
        TruthDistances.build(square, torch.tensor([0]), "dijkstra", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_bad_input_names_the_argument(square: Mesh) -> None:
    identity = torch.arange(9)
    with pytest.raises(ValueError, match=r"truth: vertices of square must lie in 0\.\.8, got 9\.\.9"):
        geodesic_errors(square, identity, torch.tensor([9]), at=torch.tensor([0]))
    with pytest.raises(ValueError, match=r"predicted: vertices of square must lie in 0\.\.8, got -1\.\.-1"):
        geodesic_errors(square, torch.tensor([-1]), torch.tensor([0]))
    with pytest.raises(ValueError, match=r"at: source vertices must lie in 0\.\.8, got 9\.\.9"):
        geodesic_errors(square, identity, torch.tensor([0]), at=torch.tensor([9]))
    with pytest.raises(ValueError, match="a true point for each of the 9 predictions"):
        geodesic_errors(square, identity, torch.tensor([0]))
    with pytest.raises(ValueError, match="expected at least one point"):
        geodesic_errors(square, identity, identity[:0], at=identity[:0])
    store = TruthDistances.build(square, torch.tensor([0, 1]), "dijkstra")
    with pytest.raises(ValueError, match=r"7 true vertices of square have no row here, first 2"):
        geodesic_errors(square, identity, identity, distances=store)
    with pytest.raises(ValueError, match="built for square, not for big"):
        geodesic_errors(Mesh(square.verts * 2, square.faces, "big"), identity, identity, distances=store)
    flat = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], name="flat")
    with pytest.raises(ValueError, match="flat has area 0"):
        TruthDistances.build(flat, torch.tensor([0]))
    with pytest.raises(ValueError, match="bary: expected weights"):
        SurfacePoints(torch.tensor([[0, 1, 2]]), torch.tensor([[0.5, 0.6, 0.0]]))
    with pytest.raises(ValueError, match=r"face_ids: must lie in 0\.\.7"):
        SurfacePoints.from_faces(square, torch.tensor([8]), torch.tensor([[1.0, 0.0, 0.0]]))


def test_spread_points_are_far_apart(square: Mesh) -> None:
    assert sorted(spread_points(square, 4, start=0).tolist()) == [0, 2, 6, 8]


def has_exact() -> bool:
    try:
        import pygeodesic  # noqa: F401
    except ImportError:
        return False
    return True


def count_calls(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The sources of every later call of the geodesic solver."""
    asked: list[list[int]] = []
    solve = torchqm.geometry.geodesic.distances

    def counting(mesh: Mesh, sources: torch.Tensor, method: str = "fast_marching") -> torch.Tensor:
        asked.append(sources.tolist())
        return solve(mesh, sources, method=method)

    monkeypatch.setattr(torchqm.geometry.geodesic, "distances", counting)
    return asked
