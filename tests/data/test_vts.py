"""Sets with .vts files in every folder layout, and what is wrong with them."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import shapes as exact
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes
from torchqm.geometry import save_mesh

FOLDERS = [
    ("off", "corres"),
    ("shapes", "correspondences"),
    ("off_2", "corres"),
    (".", "corres"),
    ("vtx_5k", "vtx_5k/corres"),
]


def faust(root, meshes="off", truth="corres", base=1, numbers=(0, 79, 80)):
    """Three shapes of six vertices; template points 0, 1, 2 lie at vertices (5, n, 0) and mirror as 0 <-> 2."""
    for n, number in enumerate(numbers):
        name = f"tr_reg_{number:03d}"
        write_mesh(root / meshes / f"{name}.off")
        write_lines(root / truth / f"{name}.vts", [5 + base, n % 5 + base, base])
        write_lines(root / truth / f"{name}.sym.vts", [base, n % 5 + base, 5 + base])


@pytest.mark.parametrize(("meshes", "truth"), FOLDERS)
@pytest.mark.parametrize("base", [0, 1])
def test_truth_is_the_same_in_every_folder_and_from_either_base(tmp_path, meshes, truth, base):
    faust(tmp_path, meshes, truth, base)
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "vts"
    assert shapes.names == ["tr_reg_000", "tr_reg_079", "tr_reg_080"]
    assert shapes.classes == ["faust"]
    assert any(f"{base}-based" in sentence for sentence in shapes.recognised)
    assert any("one template of 3 points" in sentence for sentence in shapes.recognised)
    truth_ = shapes.truth("tr_reg_079", "tr_reg_080")
    assert truth_.at.tolist() == [5, 1, 0]
    assert truth_.points.tolist() == [5, 2, 0]
    assert f"{base}-based" in truth_.source
    mirrored = shapes.mirrored_truth("tr_reg_079", "tr_reg_080")
    assert mirrored.at.tolist() == [5, 1, 0]
    assert mirrored.points.tolist() == [0, 2, 5]
    assert found(shapes, "missing") == found(shapes, "malformed") == {}


def test_meshes_and_vts_files_side_by_side(tmp_path):
    for name in ("a1", "a2"):
        write_mesh(tmp_path / f"{name}.obj")
        write_lines(tmp_path / f"{name}.vts", [1, 6])
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "vts"
    assert shapes.truth("a1", "a2").points.tolist() == [0, 5]
    assert found(shapes) == {}


def test_splits_of_the_known_sets(tmp_path):
    faust(tmp_path / "f")
    assert open_shapes(tmp_path / "f").split() == {"train": ["tr_reg_000", "tr_reg_079"], "test": ["tr_reg_080"]}
    for number in (0, 50, 52):
        write_mesh(tmp_path / f"scape/off/mesh{number:03d}.off")
        write_lines(tmp_path / f"scape/corres/mesh{number:03d}.vts", [1, 6])
    scape = open_shapes(tmp_path / "scape")
    assert scape.split() == {"train": ["mesh000", "mesh050"], "test": ["mesh052"]}
    assert found(scape) == {"SCAPE": "3 shapes; SCAPE has 71"}
    for number in (3, 90):
        write_mesh(tmp_path / f"faust_remeshed/shapes/{number:03d}.off")
        write_lines(tmp_path / f"faust_remeshed/correspondences/{number:03d}.vts", [1, 6])
    assert open_shapes(tmp_path / "faust_remeshed").split() == {"train": ["003"], "test": ["090"]}


def test_classes_with_templates_of_their_own(tmp_path):
    """TOSCA as Ren et al. remeshed it, with its list of pairs."""
    for name, ids in (("cat0", [1, 6]), ("cat1", [2, 5]), ("dog0", [1, 2, 3]), ("dog1", [4, 5, 6])):
        write_mesh(tmp_path / f"vtx_5k/{name}.off")
        write_lines(tmp_path / f"vtx_5k/corres/{name}.vts", ids)
    write_lines(tmp_path / "test_pairs.txt", ["cat0 cat1", "dog1 dog0"])
    for root in (tmp_path, tmp_path / "vtx_5k"):
        shapes = open_shapes(root)
        assert shapes.classes == ["cat", "dog"]
        assert shapes.published_pairs() == [("cat0", "cat1"), ("dog1", "dog0")]
        assert shapes.truth("dog0", "dog1").points.tolist() == [3, 4, 5]
        assert any("cat 2, dog 3" in sentence for sentence in shapes.recognised)
        assert shapes.split() is None
        with pytest.raises(TruthError, match=r"no truth from cat0 to dog0: .* templates of their own"):
            shapes.truth("cat0", "dog0")
        assert shapes.symmetry("cat0") is None
        assert shapes.mirrored_truth("cat0", "cat1") is None
        with pytest.raises(ValueError, match="no shape 'cat7'; shapes here: cat0, cat1, dog0, dog1"):
            shapes.truth("cat0", "cat7")
    write_lines(tmp_path / "test_pairs.txt", ["cat0 cat1", "cat0 cat9"])
    assert "test_pairs.txt:2: there is no shape 'cat9'" in found(shapes, "malformed")["test_pairs.txt"]


def test_what_is_missing_and_malformed_is_named(tmp_path):
    faust(tmp_path, numbers=range(8))
    name = "tr_reg_00{}".format
    (tmp_path / f"corres/{name(0)}.vts").unlink()
    (tmp_path / f"corres/{name(1)}.sym.vts").unlink()
    (tmp_path / f"off/{name(2)}.off").unlink()
    write_lines(tmp_path / f"corres/{name(3)}.vts", [1, 2, 7])
    write_lines(tmp_path / f"corres/{name(4)}.vts", [1, "x", 3])
    write_lines(tmp_path / f"corres/{name(5)}.vts", [1, 2])
    (tmp_path / f"off/{name(6)}.off").write_text("OFF\n6 4 0\n0 0 0\n")
    shapes = open_shapes(tmp_path)
    missing, malformed = found(shapes, "missing"), found(shapes, "malformed")
    assert set(missing) == {name(0), name(1), name(2)}
    assert "tr_reg_000.vts: no such file" in missing[name(0)]
    assert "tr_reg_001.sym.vts: no such file" in missing[name(1)]
    assert "its mesh is missing" in missing[name(2)]
    assert set(malformed) == {name(3), name(4), name(5), name(6)}
    assert "tr_reg_003.vts:3: vertex 7 is out of range" in malformed[name(3)]
    assert "tr_reg_004.vts:2: expected one number, got 'x'" in malformed[name(4)]
    assert "2 lines where the template of its class has 3 points" in malformed[name(5)]
    assert "truncated" in malformed[name(6)]
    for number, message in ((0, "no such file"), (3, "003.vts:3"), (4, "004.vts:2"), (5, "2 lines where")):
        with pytest.raises(TruthError, match=message):
            shapes.truth(name(number), name(7))
    assert shapes.truth(name(7), name(1)).points.tolist() == [5, 1, 0]


def test_one_file_that_counts_from_the_other_number_is_malformed(tmp_path):
    faust(tmp_path, numbers=range(4))
    write_lines(tmp_path / "corres/tr_reg_002.vts", [5, 2, 0])
    shapes = open_shapes(tmp_path)
    assert shapes.base == 1
    assert "tr_reg_002.vts:3: vertex 0 is out of range" in found(shapes, "malformed")["tr_reg_002"]


def test_no_folder_of_truth(tmp_path):
    write_mesh(tmp_path / "off/tr_reg_000.off")
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "vts"
    assert list(found(shapes, "missing")) == ["corres"]
    with pytest.raises(TruthError, match=r"corres/tr_reg_000\.vts: no such file"):
        shapes.truth("tr_reg_000", "tr_reg_000")


@given(st.sets(st.integers(0, 641), max_size=40), st.integers(0, 1))
def test_symmetry_of_all_vertices_from_points_of_a_template(tmp_path_factory, left_out, base):
    """A remeshed shape has vertices that stand for no point; they take the image of a neighbour that does."""
    blob = exact.blob(2)
    root = tmp_path_factory.mktemp("blob")
    (root / "off").mkdir()
    save_mesh(blob.mesh, root / "off/blob0.off")
    points = [v for v in range(642) if v not in left_out]
    write_lines(root / "corres/blob0.vts", [v + base for v in points])
    write_lines(root / "corres/blob0.sym.vts", [v + base for v in blob.group.maps[1][points].tolist()])
    shapes = open_shapes(root)
    mirror = shapes.symmetry("blob0").maps[1]
    assert torch.equal(mirror[points], blob.group.maps[1][points])
    gap = (blob.mesh.verts[mirror] - blob.mesh.verts[blob.group.maps[1]]).norm(dim=1)
    assert float(gap.max()) <= 3 * float(blob.mesh.edge_lengths.max())
    truth = shapes.symmetry_truth("blob0")
    assert truth.at.tolist() == points


def test_a_symmetry_of_few_vertices_is_known_at_these_only(tmp_path):
    for name in ("a0", "a1"):
        write_mesh(tmp_path / f"off/{name}.off", 9)
        write_lines(tmp_path / f"corres/{name}.vts", [1, 9])
        write_lines(tmp_path / f"corres/{name}.sym.vts", [9, 1])
    shapes = open_shapes(tmp_path)
    assert shapes.symmetry("a0") is None
    assert shapes.symmetry_truth("a0").points.tolist() == [8, 0]
    write_lines(tmp_path / "corres/a0.sym.vts", [9, 1, 1])
    with pytest.raises(TruthError, match=r"a0\.sym\.vts: 3 lines where"):
        open_shapes(tmp_path).symmetry("a0")
