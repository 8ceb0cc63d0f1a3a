"""SHREC07: numbered shapes with landmarks."""

import pytest
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes


def make(root, base=0, meshes=".", truth="."):
    for name, ids in (("381", [0, 3, 5]), ("400", [2, 1, 0]), ("1", [4, 5]), ("20", [0, 1])):
        write_mesh(root / meshes / f"{name}.off")
        write_lines(root / truth / f"{name}.vts", [(i + base, 0, 0, 0) for i in ids])


@pytest.mark.parametrize(("meshes", "truth"), [(".", "."), ("Meshes", "Corrs"), ("off", "landmarks")])
@pytest.mark.parametrize("base", [0, 1])
def test_landmarks_of_a_class(tmp_path, base, meshes, truth):
    make(tmp_path, base, meshes, truth)
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "shrec07"
    assert shapes.classes == ["fourleg", "human"]
    assert [shapes.shape_class(name) for name in ("1", "20", "381")] == ["human", "human", "fourleg"]
    assert any(f"{base}-based" in sentence for sentence in shapes.recognised)
    marks = shapes.truth("381", "400")
    assert (marks.at.tolist(), marks.points.tolist()) == ([0, 3, 5], [2, 1, 0])
    assert marks.source.startswith("3 landmarks")
    assert shapes.about("fourleg") == ("3 landmarks", "none")
    assert found(shapes) == {}
    with pytest.raises(TruthError, match="no truth from 1 to 381"):
        shapes.truth("1", "381")


def test_equally_many_landmarks_do_not_make_one_class(tmp_path):
    make(tmp_path)
    write_lines(tmp_path / "1.vts", [1, 2, 3])
    write_lines(tmp_path / "20.vts", [1, 2, 3])
    with pytest.raises(TruthError, match="no truth from 1 to 381"):
        open_shapes(tmp_path).truth("1", "381")


def test_malformed_and_missing_are_named(tmp_path):
    make(tmp_path)
    write_mesh(tmp_path / "21.off")
    write_mesh(tmp_path / "382.off")
    write_lines(tmp_path / "20.vts", [0, 1, 2])
    write_lines(tmp_path / "400.vts", [0, 8, 2])
    shapes = open_shapes(tmp_path)
    assert found(shapes, "note") == {"cup": "class cup has no landmarks"}
    assert list(found(shapes, "missing")) == ["382"]
    malformed = found(shapes, "malformed")
    assert "400.vts:2: vertex 8 is out of range" in malformed["400"]
    assert set(malformed) - {"400"} <= {"1", "20"}
    with pytest.raises(TruthError, match=r"382\.vts: no such file"):
        shapes.truth("381", "382")


def test_long_files_of_numbered_shapes_are_no_landmarks(tmp_path):
    for name in ("1", "2"):
        write_mesh(tmp_path / f"off/{name}.off", 300)
        write_lines(tmp_path / f"corres/{name}.vts", range(1, 301))
    assert open_shapes(tmp_path).layout == "vts"
