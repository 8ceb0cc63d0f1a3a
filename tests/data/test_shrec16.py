"""SHREC16: truth from a part to its full shape as points inside triangles or as vertices."""

import pytest
import torch
from references import shapes as exact
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.geometry import save_mesh

ROWS = [(0, 0.2, 0.3, 0.5), (1, 1, 0, 0), (5, 0, 0, 1), (2, 0.6, 0.4, 0)]  # triangles 0, 1, 5, 2 of a strip of 8


def as_published(root, base=1, kinds=("cuts", "holes")):
    """A cat of 8 vertices and 6 triangles and parts of 4 vertices; the mirror image exchanges triangles t and 5 - t."""
    write_mesh(root / "null/cat.off", 8)
    for kind in kinds:
        write_mesh(root / f"{kind}/{kind}_cat_shape_1.off", 4)
        write_lines(root / f"{kind}/{kind}_cat_shape_1.baryc_gt", [(t + base, *w) for t, *w in ROWS])
        write_lines(root / f"{kind}/{kind}_cat_shape_1.baryc_gt_sym", [(5 - t + base, *w) for t, *w in ROWS])


@pytest.mark.parametrize("base", [0, 1])
def test_points_inside_triangles(tmp_path, base):
    as_published(tmp_path, base)
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "shrec16"
    assert shapes.names == ["cat", "cuts_cat_shape_1", "holes_cat_shape_1"]
    assert shapes.classes == ["cat"]
    assert f"triangles in *.baryc_gt: {base}-based" in shapes.recognised[1]
    assert shapes.published_pairs() == [("cuts_cat_shape_1", "cat"), ("holes_cat_shape_1", "cat")]
    truth = shapes.truth("cuts_cat_shape_1", "cat")
    assert isinstance(truth.points, SurfacePoints)
    assert truth.at.tolist() == [0, 1, 2, 3]
    assert truth.points.corners.tolist() == [[0, 1, 2], [1, 2, 3], [5, 6, 7], [2, 3, 4]]
    torch.testing.assert_close(truth.points.bary[0], torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64))
    assert truth.vertices.tolist() == [2, 1, 7, 2]
    mirrored = shapes.mirrored_truth("cuts_cat_shape_1", "cat")
    assert mirrored.points.corners.tolist() == [[5, 6, 7], [4, 5, 6], [0, 1, 2], [3, 4, 5]]
    back = shapes.truth("cat", "cuts_cat_shape_1")
    assert (back.at.tolist(), back.points.tolist()) == ([2, 1, 7, 2], [0, 1, 2, 3])
    assert found(shapes) == {}
    with pytest.raises(TruthError, match="it leads from a part to its full shape in null/"):
        shapes.truth("cuts_cat_shape_1", "holes_cat_shape_1")


def test_vertices_as_ulrssm_has_them(tmp_path):
    write_mesh(tmp_path / "null/off/david.off", 8)
    write_mesh(tmp_path / "cuts/off/cuts_david_shape_3.off", 4)
    write_lines(tmp_path / "cuts/corres/cuts_david_shape_3.vts", [8, 1, 2, 3])
    shapes = open_shapes(tmp_path)
    assert shapes.truth("cuts_david_shape_3", "david").points.tolist() == [7, 0, 1, 2]
    assert shapes.truth("david", "cuts_david_shape_3").at.tolist() == [7, 0, 1, 2]
    assert shapes.about("david") == (".vts", "mirror plane of david")
    assert found(shapes) == {}


def test_the_full_shape_has_the_symmetry_of_its_canonical_pose(tmp_path):
    """Without .baryc_gt_sym the mirrored truth comes from the plane, corner by corner."""
    blob = exact.blob(2)
    (tmp_path / "null").mkdir()
    save_mesh(blob.mesh, tmp_path / "null/cat.off")
    write_mesh(tmp_path / "cuts/cuts_cat_shape_1.off", 3)
    write_lines(tmp_path / "cuts/cuts_cat_shape_1.baryc_gt", [(1, 0.2, 0.3, 0.5), (1280, 0, 0, 1), (7, 1, 0, 0)])
    shapes = open_shapes(tmp_path)
    assert torch.equal(shapes.symmetry("cat").maps, blob.group.maps)
    assert shapes.symmetry("cuts_cat_shape_1") is None
    truth = shapes.truth("cuts_cat_shape_1", "cat")
    mirrored = shapes.mirrored_truth("cuts_cat_shape_1", "cat")

    def positions(points):
        return (blob.mesh.verts[points.corners] * points.bary[..., None]).sum(1)

    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(positions(mirrored.points), positions(truth.points) * flip)


def test_triangles_that_the_full_shape_has_lost_are_left_out_if_few(tmp_path):
    rows = [(t % 6 + 1, 1, 0, 0) for t in range(40)]
    write_mesh(tmp_path / "null/cat.off", 8)
    write_mesh(tmp_path / "cuts/cuts_cat_shape_1.off", 40)
    path = tmp_path / "cuts/cuts_cat_shape_1.baryc_gt"
    write_lines(path, [*rows[:7], (9, 1, 0, 0), *rows[8:]])
    shapes = open_shapes(tmp_path)
    truth = shapes.truth("cuts_cat_shape_1", "cat")
    assert truth.at.tolist() == [v for v in range(40) if v != 7]
    assert "without 1 lines with triangles that null/cat has lost" in truth.source
    assert list(found(shapes, "note")) == ["cuts_cat_shape_1"]
    write_lines(path, [*rows[:30], *[(9, 1, 0, 0)] * 10])
    shapes = open_shapes(tmp_path)
    message = r"baryc_gt:31: triangle 9 is out of range: null/cat has 6, 1 to 6 counted from 1 \(10 of 40"
    with pytest.raises(TruthError, match=message):
        shapes.truth("cuts_cat_shape_1", "cat")
    assert list(found(shapes, "malformed")) == ["cuts_cat_shape_1"]


def test_malformed_and_missing_are_named(tmp_path):
    as_published(tmp_path)
    write_lines(tmp_path / "cuts/cuts_cat_shape_1.baryc_gt", [(1, 0, 0, 1)])
    write_lines(tmp_path / "holes/holes_cat_shape_1.baryc_gt_sym", [(1, 0, 0, 2)] * 4)
    write_mesh(tmp_path / "cuts/cuts_wolf_shape_1.off", 4)
    write_mesh(tmp_path / "holes/holes_cat_shape_2.off", 4)
    shapes = open_shapes(tmp_path)
    malformed, missing = found(shapes, "malformed"), found(shapes, "missing")
    assert "1 lines, but cuts_cat_shape_1.off has 4 vertices" in malformed["cuts_cat_shape_1"]
    assert "baryc_gt_sym:1: expected three weights" in malformed["holes_cat_shape_1"]
    assert set(missing) == {"wolf", "cuts_wolf_shape_1", "holes_cat_shape_2"}
    assert "wolf.off: the full shape of some parts is missing" in missing["wolf"]
    with pytest.raises(TruthError, match=r"no \.baryc_gt or \.vts file for this part"):
        shapes.truth("holes_cat_shape_2", "cat")


def test_a_test_set_without_any_truth_is_said_once(tmp_path):
    as_published(tmp_path)
    for path in tmp_path.glob("*/*.baryc_gt*"):
        path.unlink()
    shapes = open_shapes(tmp_path)
    assert found(shapes) == {"*.baryc_gt": "no part has a truth (.baryc_gt, .vts)"}
    assert shapes.published_pairs() == []
