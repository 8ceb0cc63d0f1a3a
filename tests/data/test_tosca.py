"""TOSCA as first published, in both formats."""

import numpy as np
import pytest
import torch
from references import shapes as exact
from references.folders import found, strip, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes

ENDINGS = (".mat", ".vert")


def save(path, mesh):
    verts, faces = mesh.numpy()
    np.savetxt(path, verts, fmt="%.17g")
    np.savetxt(path.with_suffix(".tri"), faces + 1, fmt="%d")


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("base", [0, 1])
def test_vertex_ids_agree_inside_a_class_whatever_triangles_count_from(tmp_path, ending, base):
    for name, count in (("cat0", 6), ("cat2", 6), ("cat10", 6), ("dog1", 7)):
        write_mesh(tmp_path / f"{name}{ending}", count, base)
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "tosca-" + ending[1:]
    assert shapes.names == ["cat0", "cat2", "cat10", "dog1"]
    assert shapes.classes == ["cat", "dog"]
    assert f"{base}-based" in shapes.recognised[1]
    assert torch.equal(shapes.mesh("cat2").faces, strip(6).faces)
    truth = shapes.truth("cat2", "cat10")
    assert truth.at.tolist() == truth.points.tolist() == list(range(6))
    assert truth.source == "vertex ids agree in class cat"
    with pytest.raises(TruthError, match=r"no truth from cat0 to dog1: .* of 'cat' and 'dog'"):
        shapes.truth("cat0", "dog1")
    assert found(shapes) == {}
    assert shapes.about("cat")[1] == "mirror plane of cat0"
    assert shapes.about("dog")[1] == "none"


def test_the_symmetry_is_that_of_the_undeformed_pose(tmp_path):
    blob = exact.blob(2)
    save(tmp_path / "cat0.vert", blob.mesh)
    bent = blob.mesh.verts + 0.4 * torch.sin(2 * blob.mesh.verts[:, [1, 2, 0]] + 0.3)
    save(tmp_path / "cat1.vert", blob.mesh.moved(bent))
    save(tmp_path / "dog0.vert", exact.blob(1).mesh)
    shapes = open_shapes(tmp_path)
    assert torch.equal(shapes.symmetry("cat1").maps, blob.group.maps)
    assert shapes.symmetry("cat1") is shapes.symmetry("cat0")
    assert shapes.symmetry_truth("cat1").source == "mirror plane of cat0"
    assert shapes.symmetry("dog0") is None
    assert shapes.symmetry_truth("dog0") is None
    mirrored = shapes.mirrored_truth("cat0", "cat1")
    assert torch.equal(mirrored.points, blob.group.maps[1])


def test_all_symmetries_of_a_pose_with_several_planes(tmp_path):
    blob = exact.blob(4)
    save(tmp_path / "cat0.vert", blob.mesh)
    shapes = open_shapes(tmp_path)
    found_ = {tuple(row) for row in shapes.symmetry("cat0").maps.tolist()}
    assert found_ == {tuple(row) for row in blob.group.maps.tolist()}
    assert shapes.symmetry_truth("cat0") is None


@pytest.mark.parametrize("ending", ENDINGS)
def test_another_vertex_count_is_malformed_and_left_out(tmp_path, ending):
    for name, count in (("cat0", 6), ("cat1", 6), ("cat2", 5)):
        write_mesh(tmp_path / f"{name}{ending}", count)
    shapes = open_shapes(tmp_path)
    assert shapes.names == ["cat0", "cat1"]
    said = "5 vertices where class 'cat' has 6: no truth by vertex id, left out"
    assert found(shapes, "malformed") == {"cat2": said}
    with pytest.raises(TruthError, match=r"cat2\S*: 5 vertices where class 'cat' has 6"):
        shapes.truth("cat0", "cat2")


def test_unreadable_files_are_named(tmp_path):
    for name in ("cat0", "cat1", "cat2", "cat3"):
        write_mesh(tmp_path / f"{name}.vert")
    (tmp_path / "cat1.tri").unlink()
    write_lines(tmp_path / "cat2.tri", [(1, 2, 3), (2, 3, 9)])
    (tmp_path / "cat3.vert").unlink()
    shapes = open_shapes(tmp_path)
    assert "cat1.tri: no such file" in found(shapes, "malformed")["cat1"]
    assert "refers to vertex 8" in found(shapes, "malformed")["cat2"]
    assert found(shapes, "missing") == {"cat3": f"{tmp_path}/cat3.tri has no .vert file beside it"}
    write_mesh(tmp_path / "mats/cat0.mat")
    (tmp_path / "mats/cat1.mat").write_bytes(b"no MATLAB file")
    mats = open_shapes(tmp_path / "mats")
    assert mats.names == ["cat0"]
    assert "cat1.mat: no MATLAB file" in found(mats, "malformed")["cat1"]
