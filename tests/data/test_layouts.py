"""Which layout a folder is taken for, and what is said about one that is none."""

import pytest
from references.folders import write_lines, write_mesh

from torchqm.data.base import LayoutError
from torchqm.data.layouts import LAYOUTS, open_shapes


def make(root, layout):
    """The smallest folder of a layout."""
    if layout == "scb":
        write_mesh(root / "TOSCA/Meshes/cat0.off")
    elif layout == "shrec16":
        write_mesh(root / "null/cat.off")
        write_mesh(root / "cuts/cuts_cat_shape_1.off")
    elif layout == "shrec19":
        write_mesh(root / "off/1.off")
        write_mesh(root / "off/2.off")
        write_lines(root / "corres/1_2.map", range(1, 7))
    elif layout == "dt4d":
        write_mesh(root / "off/crypto/a.off")
        write_lines(root / "corres/crypto/a.vts", [1, 6])
    elif layout == "shrec07":
        write_mesh(root / "381.off")
        write_lines(root / "381.vts", [(0, 0, 0, 0)])
    elif layout == "smal":
        for name in ("cow_1", "hippo_2"):
            write_mesh(root / f"off/{name}.off")
            write_lines(root / f"corres/{name}.vts", [1, 6])
    elif layout == "vts":
        write_mesh(root / "off_2/tr_reg_080.off")
        write_lines(root / "corres/tr_reg_080.vts", [1, 6])
    elif layout == "faust-registrations":
        write_mesh(root / "tr_reg_000.ply")
    elif layout == "tosca-mat":
        write_mesh(root / "cat0.mat")
    elif layout == "tosca-vert":
        write_mesh(root / "cat0.vert")
    else:
        write_mesh(root / "bunny.obj")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_is_recognised(tmp_path, layout):
    make(tmp_path, layout)
    shapes = open_shapes(tmp_path)
    assert shapes.layout == layout
    assert shapes.root == tmp_path
    assert len(shapes.names) >= 1
    for name in shapes.names:
        assert shapes.mesh(name).n_verts == shapes.n_verts(name) == 6
        assert shapes.mesh(name).name == name
        assert shapes.shape_class(name) in shapes.classes
    with pytest.raises(ValueError, match="no shape 'nobody'"):
        shapes.path("nobody")
    with pytest.raises(ValueError, match="no shape 'nobody'"):
        shapes.shape_class("nobody")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_folder_that_holds_one_of_a_known_layout_points_to_it(tmp_path, layout):
    make(tmp_path / "data" / layout, layout)
    with pytest.raises(LayoutError, match=rf"no known layout, but \S*/data/{layout} has one; known are scb, "):
        open_shapes(tmp_path / "data")


def test_no_set_of_shapes(tmp_path):
    with pytest.raises(LayoutError, match="nowhere: no such folder"):
        open_shapes(tmp_path / "nowhere")
    with pytest.raises(LayoutError, match="the folder is empty"):
        open_shapes(tmp_path)
    write_lines(tmp_path / "notes.txt", ["hello"])
    with pytest.raises(LayoutError, match="is a file, not a folder"):
        open_shapes(tmp_path / "notes.txt")
    with pytest.raises(LayoutError, match=r"it holds notes\.txt\); known are"):
        open_shapes(tmp_path)
    (tmp_path / "TOSCA/Meshes").mkdir(parents=True)
    with pytest.raises(LayoutError, match=r"TOSCA/Meshes has no \.off files"):
        open_shapes(tmp_path)


def test_the_built_in_creatures_have_a_root_of_their_own():
    assert open_shapes("synthetic:").layout == "synthetic"
    with pytest.raises(LayoutError):
        open_shapes("synthetic:no-such-option=1")


def test_tosca_files_beside_more_meshes_of_another_kind_make_no_tosca(tmp_path):
    for name in ("a", "b"):
        write_mesh(tmp_path / f"{name}.off")
    write_mesh(tmp_path / "dist1.mat")
    assert open_shapes(tmp_path).layout == "plain"
