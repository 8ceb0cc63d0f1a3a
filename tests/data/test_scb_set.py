"""The SCB folder as a set of shapes, hand-made and, where it is at hand, the real one."""

import os

import pytest
import torch
from references import shapes as exact
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes
from torchqm.data.published import RESULT_FOLDER
from torchqm.geometry import MeshError, save_mesh

REAL = os.environ.get("TORCHQM_SCB")
BLOCK = "Stats:\n\tAverage\t[0.1]\n\tPerSampleErrors\t[0.1]\n"


@pytest.fixture
def root(tmp_path):
    """Two cats and a broken one, two gorillas with landmarks; one published pair of cats and one of absent wolves."""
    for name, count in (("cat0", 6), ("cat1", 6), ("cat2", 5), ("gorilla1", 6), ("gorilla5", 6)):
        write_mesh(tmp_path / f"TOSCA/Meshes/{name}.off", count)
    for cls in ("cat", "gorilla"):
        write_lines(tmp_path / f"TOSCA/Corrs/{cls}.pid", [(0, 0, 0, 0), (4, 0, 0, 0), (2, 0, 0, 0)])
        write_lines(tmp_path / f"TOSCA/Corrs/{cls}.sym.info", ["0 1", "2"])
    for pair in ("cat0_to_cat1", "cat1_to_cat7"):
        write_lines(tmp_path / RESULT_FOLDER / f"BenchResult_BlendedMap_{pair}.txt", [BLOCK])
    return tmp_path


def test_truth_pairs_and_landmarks(root):
    shapes = open_shapes(root)
    assert shapes.layout == "scb"
    assert shapes.names == ["cat0", "cat1", "gorilla1", "gorilla5"]
    assert shapes.truth("cat1", "cat0").points.tolist() == list(range(6))
    assert shapes.published_pairs() == [("cat0", "cat1")]
    assert list(shapes.skipped_pairs()) == [("cat1", "cat7")]
    assert "2 pairs with a published result of BlendedMap, 1 of them" in shapes.recognised[-1]
    assert shapes.about("cat") == ("same vertex ids", "mirror plane of cat0")
    assert shapes.about("gorilla") == ("same vertex ids", "landmarks")
    assert shapes.symmetry("gorilla1") is None
    swap = shapes.symmetry_truth("gorilla1")
    assert swap.at.tolist() == [0, 4, 2]
    assert swap.points.tolist() == [4, 0, 2]
    mirrored = shapes.mirrored_truth("gorilla1", "gorilla5")
    assert dict(zip(mirrored.at.tolist(), mirrored.points.tolist(), strict=True)) == {0: 4, 4: 0, 2: 2}
    assert open_shapes(root / "TOSCA").root == root.resolve()


def test_the_symmetry_of_a_class_is_the_plane_of_its_undeformed_pose(tmp_path):
    blob = exact.blob(2)
    (tmp_path / "TOSCA/Meshes").mkdir(parents=True)
    save_mesh(blob.mesh, tmp_path / "TOSCA/Meshes/wolf0.off")
    save_mesh(blob.mesh.moved(blob.mesh.verts**3), tmp_path / "TOSCA/Meshes/wolf1.off")
    shapes = open_shapes(tmp_path)
    assert torch.equal(shapes.symmetry("wolf1").maps, blob.group.maps)
    assert shapes.landmark_symmetry("wolf1") is None
    assert shapes.published_pairs() == []


def test_what_is_missing_and_malformed_is_named(root):
    assert found(open_shapes(root), "malformed") == {
        "cat2": "5 vertices where class 'cat' has 6: no truth by vertex id, left out"
    }
    assert "cat7.off" in found(open_shapes(root), "missing")["cat1 -> cat7"]
    (root / "TOSCA/Meshes/cat3.off").write_text("not a mesh")
    (root / "TOSCA/Meshes/cat4.off").write_text((root / "TOSCA/Meshes/cat0.off").read_text()[:-9])
    write_lines(root / "TOSCA/Corrs/cat.pid", [(0, 0, 0, 0), (6, 0, 0, 0)])
    write_lines(root / "TOSCA/Corrs/gorilla.sym.info", ["0 1"])
    write_mesh(root / "TOSCA/Meshes/dog0.off")
    (root / RESULT_FOLDER / "BenchResult_BlendedMap_cat0_to_cat1.txt").write_text(BLOCK[:20])
    shapes = open_shapes(root)
    malformed, missing = found(shapes, "malformed"), found(shapes, "missing")
    assert "cat3" not in shapes.names
    assert "cat3.off" in malformed["cat3"]
    assert "cat4.off: truncated" in malformed["cat4"]
    assert "cat.pid:2: vertex 6" in malformed["cat"]
    assert "gorilla.sym.info" in malformed["gorilla"]
    assert "BenchResult_BlendedMap_cat0_to_cat1.txt" in malformed
    assert "dog.pid does not exist" in missing["dog"]
    with pytest.raises(TruthError, match=r"gorilla\.sym\.info"):
        shapes.symmetry_truth("gorilla1")


def test_no_results_is_no_fault(root):
    for path in (root / RESULT_FOLDER).iterdir():
        path.unlink()
    shapes = open_shapes(root)
    assert shapes.published_pairs() == []
    assert "no list of published pairs" in found(shapes, "note")[RESULT_FOLDER.name]
    assert found(shapes, "missing") == {}


@pytest.mark.skipif(not REAL, reason="TORCHQM_SCB does not point to an SCB folder")
def test_real_folder():
    shapes = open_shapes(str(REAL))
    assert shapes.layout == "scb"
    problems = shapes.problems()
    assert [problem for problem in problems if problem.severity == "missing"] == []
    if len(shapes.classes) == 9:
        malformed = {problem.name for problem in problems if problem.severity == "malformed"}
        assert malformed == {"cat11", "cat12", "centaur6"}
        assert len(shapes.names) == 80
        assert len(shapes.published_pairs()) == 71
    first, second = "wolf0", "wolf1"
    mirror = shapes.symmetry(first)
    assert torch.equal(mirror.maps[1][mirror.maps[1]], mirror.maps[0])
    assert torch.equal(shapes.mirrored_truth(first, second).points, mirror.maps[1])


def test_an_undeformed_pose_that_cannot_be_read_is_no_class_without_symmetry(root):
    path = root / "TOSCA/Meshes/cat0.off"
    path.write_text("\n".join(path.read_text().splitlines()[:4]))  # the header still promises all vertices
    with pytest.raises(MeshError, match=r"cat0\.off"):
        open_shapes(root).symmetry("cat1")


def test_a_mesh_without_a_header_is_left_out_with_its_reason(root):
    (root / "TOSCA/Meshes/cat1.off").write_text("no mesh")
    shapes = open_shapes(root)
    assert "cat1" not in shapes.names
    assert list(shapes.unreadable) == ["cat1"]
    assert set(shapes.excluded) == {"cat1", "cat2"}
    with pytest.raises(TruthError, match=r"cat1\.off"):
        shapes.truth("cat0", "cat1")
