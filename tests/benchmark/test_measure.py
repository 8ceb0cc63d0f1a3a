"""Where a map is measured, and against which true maps."""

import torch
from references.sets import Blobs

from torchqm.benchmark.measure import evaluation_rows, measure_pair, measure_symmetry
from torchqm.benchmark.plan import Settings
from torchqm.data.base import Truth
from torchqm.data.synthetic_set import SyntheticShapes
from torchqm.evaluate import SurfacePoints
from torchqm.geometry import Mesh


def settings(tmp_path, points=20):
    return Settings("nowhere", tmp_path, points, "dijkstra")


def test_the_true_map_has_no_error_and_its_mirror_image_is_a_flip(tmp_path):
    shapes = Blobs()
    truth = shapes.truth("two-0", "two-1").points
    direct = measure_pair(shapes, "two-0", "two-1", truth, settings(tmp_path))
    assert direct.row["plain_mean"] == direct.row["orbit_mean"] == 0
    assert (direct.row["points"], direct.row["flip_map"]) == (20, False)
    mirrored = measure_pair(shapes, "two-0", "two-1", shapes.symmetry("two-1").maps[1, truth], settings(tmp_path))
    assert mirrored.row["map_mean"] == 0 < mirrored.row["plain_mean"]
    assert mirrored.row["flip_map"] is True


def test_a_larger_group_and_none(tmp_path):
    shapes = Blobs()
    turned = shapes.symmetry("eight-0").maps[5]
    row = measure_pair(shapes, "eight-0", "eight-0", turned, settings(tmp_path, 0)).row
    assert (row["true_maps"], row["map_mean"]) == (8, 0)
    n = shapes.mesh("flat-0").n_verts
    found = measure_pair(shapes, "flat-0", "flat-0", torch.arange(n), settings(tmp_path, 5))
    assert list(found.errors) == ["plain"]  # nothing is known of its symmetry
    assert measure_symmetry(shapes, "flat-0", torch.arange(n), settings(tmp_path)) is None


def test_a_reflection_known_at_landmarks_only(tmp_path, monkeypatch):
    shapes = Blobs()
    group, truth = shapes.symmetry("two-1"), shapes.truth("two-0", "two-1")
    at = torch.tensor([3, 30, 77])
    monkeypatch.setattr(shapes, "symmetry", lambda name: None)
    mirrored = Truth(at, group.maps[1, truth.points[at]], "landmarks")
    monkeypatch.setattr(shapes, "mirrored_truth", lambda first, second: mirrored)
    found = measure_pair(shapes, "two-0", "two-1", group.maps[1, truth.points], settings(tmp_path))
    assert (found.row["points"], found.row["points_mirrored"]) == (20, 3)
    assert len(found.errors["plain"]) == 20
    assert found.errors["map"] == [0, 0, 0]
    assert found.row["flip_map"] is True


def test_points_in_faces_and_vertices_go_together(tmp_path):
    shapes = SyntheticShapes("synthetic:kinds=biped;poses=1;verts=1000")
    (name,) = shapes.names
    assert isinstance(shapes.mirrored_truth(name, name).points, SurfacePoints)
    found = measure_pair(shapes, name, name, torch.arange(shapes.mesh(name).n_verts), settings(tmp_path))
    assert found.row["plain_mean"] == 0
    symmetric = measure_symmetry(shapes, name, shapes.symmetry(name).maps[1], settings(tmp_path))
    assert 0 < symmetric.row["symmetry_mean"] < 0.05


def test_points_are_spread_and_the_same_each_time(tmp_path):
    shapes = Blobs()
    n = shapes.mesh("two-0").n_verts
    rows = evaluation_rows(shapes, "two-0", torch.arange(n), settings(tmp_path))
    assert len(rows.unique()) == 20
    few = torch.arange(0, n, 3)
    among = evaluation_rows(shapes, "two-0", few, settings(tmp_path))
    assert len(among.unique()) == 20
    assert int(among.max()) < len(few)
    verts = shapes.mesh("two-0").verts
    apart = [torch.pdist(verts[chosen]).min() for chosen in (rows, few[among], torch.arange(20))]
    assert min(apart[:2]) > apart[2]
    assert len(evaluation_rows(shapes, "two-0", few, settings(tmp_path, 0))) == len(few)


def test_vertices_of_no_face_are_not_measured(tmp_path, monkeypatch):
    """No path leads to them, and no method finds them: they would make every mean infinite."""
    shapes = Blobs()
    mesh, plain = shapes.mesh("flat-0"), shapes.mesh
    loose = Mesh(torch.cat([mesh.verts, torch.ones(2, 3, dtype=torch.float64)]), mesh.faces, "loose")
    monkeypatch.setattr(shapes, "mesh", lambda name: loose if name == "flat-0" else plain(name))
    at = torch.arange(loose.n_verts)
    for points in (0, loose.n_verts - 1, loose.n_verts):
        rows = evaluation_rows(shapes, "flat-0", at, settings(tmp_path, points))
        assert torch.equal(rows, torch.arange(mesh.n_verts))
    assert int(evaluation_rows(shapes, "flat-0", at[1:], settings(tmp_path, 9)).max()) < mesh.n_verts - 1
