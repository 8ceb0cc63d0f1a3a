"""torchqm.geometry.io: what the formats say is what is read, and every bad file is named with its fault."""

import os
import re
import warnings
from concurrent.futures import ThreadPoolExecutor
from threading import Event, get_ident

import numpy as np
import pytest
import scipy.io
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchqm.geometry import Mesh, MeshError, formats, load_mesh, save_mesh

VERTS = [[0, 0, 0], [1, 0, 0], [9, 9, 9], [0, 1, 0], [1, 1, 0.5]]  # vertex 2 belongs to no face
FACES = [[0, 1, 3], [1, 4, 3]]
ROWS = "0 0 0\n1 0 0\n9 9 9\n0 1 0\n1 1 .5\n"
OFF = f"OFF\n5 2 0\n{ROWS}3 0 1 3\n3 1 4 3\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 9 9 9\nv 0 1 0\nv 1 1 .5\nf 1 2 4\nf 2 5 4\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    f"element face 2\nproperty list uchar int vertex_indices\nend_header\n{ROWS}3 0 1 3\n3 1 4 3\n"
)
VERT, TRI = ROWS, "1 2 4\n2 5 4\n"
STL = """solid two
facet normal 0 0 1
 outer loop
  vertex 0 0 0
  vertex 1 0 0
  vertex 0 1 0
 endloop
endfacet
facet normal 0 0 1
 outer loop
  vertex 1 0 0
  vertex 1 1 .5
  vertex 0 1 0
 endloop
endfacet
endsolid two
"""


def write(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def mat(path, verts=VERTS, faces=FACES, **changes):
    x, y, z = np.array(verts, dtype=float).T[:, :, None]
    surface = {"X": x, "Y": y, "Z": z, "TRIV": np.array(faces, dtype=float) + 1, **changes}
    scipy.io.savemat(path, {"surface": {k: v for k, v in surface.items() if v is not None}})
    return path


def assert_is_the_mesh(mesh, faces=FACES):
    assert mesh.verts.tolist() == VERTS
    assert mesh.faces.tolist() == faces


@pytest.mark.parametrize(
    "text",
    [
        OFF,
        OFF.replace("\n", "\r\n"),
        OFF.replace("OFF\n5 2 0", "OFF 5 2 0"),
        OFF.replace("OFF\n5 2 0", "OFF5 2 0"),
        OFF.replace("5 2 0", "5 2"),
        "# made by hand\n\n" + OFF.replace("9 9 9", "\n  # the stray one\n9 9 9  # here"),
        OFF.replace("3 0 1 3", "3 0 1 3 255 0 0").replace("3 1 4 3", "3 1 4 3 0 255 0"),
        OFF.replace("3 0 1 3", "3 0 1 3 0.5 0.5 0.5 1.0"),
        "COFF\n5 2 0\n" + "".join(f"{row} 10 20 30 255\n" for row in ROWS.splitlines()) + "3 0 1 3\n3 1 4 3\n",
        "NOFF\n5 2 0\n" + "".join(f"{row} 0 0 1\n" for row in ROWS.splitlines()) + "3 0 1 3\n3 1 4 3\n",
        OFF.replace("1 1 .5", "1.0e0 1E+0 5e-1"),
        "\ufeff" + OFF,
        OFF + "\n  \n# the end\n\n",
        OFF.replace("5 2 0", "5 2 6"),
        OFF.replace("5 2 0", "5 2 2") + "0 1\n1 3\n",
        OFF.replace("5 2 0", "5 2 2") + "2 0 1\n2 1 3\n# the edges\n",
    ],
)
def test_off_variants(tmp_path, text):
    mesh = load_mesh(write(tmp_path, "two.off", text))
    assert_is_the_mesh(mesh)
    assert (mesh.name, mesh.path) == ("two", tmp_path / "two.off")


def test_off_polygons_become_fans_in_their_place(tmp_path):
    text = f"OFF\n5 3 0\n{ROWS}3 0 1 3\n4 0 1 4 3\n5 0 1 2 4 3 255 0 0\n"
    faces = [[0, 1, 3], [0, 1, 4], [0, 4, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3]]
    assert load_mesh(write(tmp_path, "a.off", text)).faces.tolist() == faces


@pytest.mark.parametrize(
    "text",
    [
        OBJ,
        "# c\nmtllib x.mtl\no thing\n" + OBJ.replace("f ", "s 1\nf "),
        OBJ.replace("f 1 2 4", "vt 0 0\nvt 1 1\nf 1/1 2/2 4/1").replace("f 2 5 4", "f 2/1 5/2 4/2"),
        OBJ.replace("f 1 2 4", "vn 0 0 1\nf 1//1 2//1 4//1").replace("f 2 5 4", "f 2/1/1 5/1/1 4/1/1"),
        OBJ.replace("f 1 2 4", "f -5 -4 -2"),
        OBJ.replace("v 0 0 0", "v 0 0 0 1 0 0"),
        "f 1 2 4\nf 2 5 4\n" + OBJ.partition("f")[0],
    ],
)
def test_obj_variants_keep_vertex_ids(tmp_path, text):
    assert_is_the_mesh(load_mesh(write(tmp_path, "two.obj", text)))


def test_obj_negative_ids_count_from_where_they_stand(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 1 1 0\nf -3 -1 -2\nf 1 2 4 3\n"
    assert load_mesh(write(tmp_path, "a.obj", text)).faces.tolist() == [[0, 1, 2], [1, 3, 2], [0, 1, 3], [0, 3, 2]]


def test_ply_text_and_binary(tmp_path):
    assert_is_the_mesh(load_mesh(write(tmp_path, "two.ply", PLY)))
    edge = PLY.replace("end_header", "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header") + "0 1\n"
    assert_is_the_mesh(load_mesh(write(tmp_path, "edge.ply", edge + "\n \n")))
    body = trimesh.Trimesh(VERTS, FACES, process=False).export(file_type="ply")
    assert_is_the_mesh(load_mesh(write(tmp_path, "b.ply", body)))


def test_stl_welds_equal_positions_in_order_of_appearance(tmp_path):
    for path in (
        write(tmp_path, "text.stl", STL),
        write(tmp_path, "binary.stl", trimesh.Trimesh(VERTS, FACES, process=False).export(file_type="stl")),
    ):
        mesh = load_mesh(path)
        assert mesh.verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]]
        assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]]


def test_other_formats_do_not_weld(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\nf 4 5 3\n"
    assert load_mesh(write(tmp_path, "seam.obj", text)).n_verts == 5


def test_tosca_mat(tmp_path):
    assert_is_the_mesh(load_mesh(mat(tmp_path / "two.mat")))


def test_tosca_vert_and_tri_by_either_file_or_the_stem(tmp_path):
    for name, content in (("two.vert", VERT), ("two.tri", TRI)):
        write(tmp_path, name, content)
    for name in ("two.vert", "two.tri", "two"):
        assert_is_the_mesh(load_mesh(str(tmp_path / name)))


def test_vert_and_tri_from_zero(tmp_path):
    write(tmp_path, "two.tri", "0 1 3\n1 4 3\n")
    assert_is_the_mesh(load_mesh(write(tmp_path, "two.vert", VERT)))


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("e.off", "", "the file is empty"),
        ("e.obj", "", "the file is empty"),
        ("e.ply", "", "the file is empty"),
        ("e.stl", "", "the file is empty"),
        ("e.mat", "", "the file is empty"),
        ("e.off", "\n# nothing\n", "no content but blank lines and comments"),
        ("j.off", "hello\nworld\n", "line 1: expected a header OFF.*found 'hello'"),
        ("j.off", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "not a text file"),
        ("j.obj", "hello\n", "no line starts with 'v' or 'f'"),
        ("j.ply", "hello\n", "not a PLY file: it starts with b'hello"),
        ("j.stl", "hello\n", "no STL or truncated"),
        ("j.stl", b"x" * 300, "no STL or truncated.*found 300 bytes"),
        ("j.mat", "hello\n", "no MATLAB file, or a truncated one"),
        ("u.xyz", "0 0 0\n", r"unknown ending '.xyz'; supported are .off, .obj, .ply, .stl, .mat, .vert, .tri"),
        ("u", "0 0 0\n", "no file ending; supported are .off"),
        ("t.off", "OFF\n", "line 1: expected the numbers of vertices, faces and edges, found the end of the file"),
        ("t.off", "OFF\n5 x\n", "line 2: expected the numbers of vertices, faces and edges, found '5 x'"),
        (
            "t.off",
            "\n".join(OFF.splitlines()[:5]),
            "truncated after line 5: expected 5 vertices and 2 faces, found 3 and 0",
        ),
        (
            "t.off",
            OFF[: OFF.index("3 1 4 3")],
            "truncated after line 8: expected 5 vertices and 2 faces, found 5 and 1",
        ),
        (
            "m.off",
            OFF + "3 0 1 4\n\n3 0 3 4\n",
            r"declares 5 vertices and 2 faces, so 7 lines, but 9 follow; the first too many is line 10: '3 0 1 4'",
        ),
        ("m.off", OFF.replace("5 2 0", "5 1 0"), "5 vertices and 1 faces, so 6 lines, but 7 follow.*line 9: '3 1 4 3'"),
        ("m.off", OFF.replace("5 2 0", "4 2 0"), "4 vertices and 2 faces, so 6 lines, but 7 follow"),
        ("m.off", "# one\n" + OFF + "# two\n" + OFF, "so 7 lines, but 16 follow; the first too many is line 12: 'OFF'"),
        ("m.off", OFF.replace("5 2 0", "5 2 2") + "0 1\n", "but 8 follow.*line 10: '0 1'"),
        ("m.off", OFF.replace("5 2 0", "5 2 1") + "3 0 1 4\n", "but 8 follow.*line 10: '3 0 1 4'"),
        (
            "m.ply",
            PLY + "3 0 1 4\n\n",
            "declares vertex 5, face 2, so 7 lines, but 8 follow; the first too many is line 17: '3 0 1 4'",
        ),
        ("m.ply", PLY.replace("face 2", "face 1"), "so 6 lines, but 7 follow.*line 16: '3 1 4 3'"),
        ("m.ply", trimesh.Trimesh(VERTS, FACES).export(file_type="ply") + b"\0" * 13, "cannot be read as PLY"),
        ("t.off", OFF[:-5], r"line 9: expected face 1 of 2 .*, found '3 1'"),
        ("t.off", OFF.replace("0 1 0", "0 1"), r"line 6: expected vertex 3 of 5 \(3 numbers\), found '0 1'"),
        ("t.off", OFF.replace("9 9 9", "9 # 9 9").replace("OFF\n", "OFF\n#\n"), "line 6: expected vertex 2 of 5"),
        ("t.off", OFF.replace("1 0 0", "1 zero 0"), "line 4: expected vertex 1 of 5.*'1 zero 0'"),
        ("t.off", OFF.replace("3 0 1 3", "3 0 1.5 3"), "line 8: expected whole numbers for face 0"),
        ("t.off", OFF.replace("3 0 1 3", "2 0 1"), "line 8: expected face 0 of 2.*at least 3"),
        ("t.obj", OBJ.replace("v 9 9 9", "v 9 9"), "line 3: expected vertex 2 of 5.*found 'v 9 9'"),
        ("t.obj", OBJ.replace("f 2 5 4", "f 2 5"), "line 7: expected a face of at least 3 corners"),
        ("t.obj", OBJ.replace("f 2 5 4", "f 0 5 4"), "line 7: expected.*ids from 1"),
        ("t.obj", OBJ.replace("f 2 5 4", "f a b c"), "line 7: expected a face"),
        ("t.ply", PLY[:100], "truncated: the PLY header has no end_header"),
        ("t.ply", PLY[: PLY.index("0 1 0")], "t.ply: (truncated|cannot be read)"),
        ("t.ply", PLY[: PLY.index("3 1 4 3")], "t.ply: (truncated|cannot be read)"),
        ("t.ply", trimesh.Trimesh(VERTS, FACES).export(file_type="ply")[:-5], "t.ply: (truncated|cannot be read)"),
        ("t.stl", STL[: STL.index("endsolid")], "truncated: line 15: expected endsolid, found 'endfacet'"),
        ("t.stl", trimesh.Trimesh(VERTS, FACES).export(file_type="stl")[:-5], "no STL or truncated.*184 bytes for 2"),
        ("i.off", OFF.replace("3 1 4 3", "3 1 5 3"), r"face 1 refers to vertex 5, but there are 5 vertices \(0 to 4\)"),
        ("i.off", OFF.replace("3 1 4 3", "3 1 -4 3"), "face 1 refers to vertex -4"),
        ("i.obj", OBJ.replace("f 2 5 4", "f 2 6 4"), "face 1 refers to vertex 5, but there are 5 vertices"),
        ("i.obj", OBJ.replace("f 2 5 4", "f 2 -6 4"), "face 1 refers to vertex -1, but there are 5 vertices"),
        ("i.ply", PLY.replace("3 1 4 3", "3 1 5 3"), "face 1 refers to vertex 5, but there are 5 vertices"),
        (
            "n.off",
            OFF.replace("9 9 9", "9 nan 9"),
            "1 of 5 vertices have NaN or infinite.*first is vertex 2 with .9, nan, 9",
        ),
        ("n.off", OFF.replace("9 9 9", "9 1e999 inf"), "first is vertex 2 with .9, inf, inf"),
        ("n.obj", OBJ.replace("9", "nan").replace("v 1 1", "v inf 1"), "2 of 5 vertices have NaN or infinite"),
        ("n.ply", PLY.replace("9 9 9", "nan nan nan"), "1 of 5 vertices have NaN or infinite"),
        ("f.off", f"OFF\n5 0 0\n{ROWS}", "no faces"),
        ("f.off", "OFF\n0 0 0\n", "no vertices"),
        ("f.off", "OFF\n0 1 0\n3 0 1 2\n", "no vertices"),
        ("f.obj", OBJ.partition("f")[0], "no faces"),
        ("f.obj", "f 1 2 3\n", "no vertices"),
        ("f.ply", PLY.replace("element face 2", "element face 0"), "no faces"),
        ("f.ply", PLY.replace("element vertex 5", "element vertex 0"), "no vertices"),
        ("f.stl", "solid a\nfacet\nendsolid a\n", "f.stl: "),
    ],
)
def test_bad_files_are_named_with_their_fault(tmp_path, name, content, fault):
    path = write(tmp_path, name, content)
    with pytest.raises(MeshError, match=f"^{re.escape(str(path))}: ") as error:
        load_mesh(path)
    assert re.search(fault, str(error.value)), str(error.value)
    assert isinstance(error.value, ValueError)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"TRIV": None}, r"no surface.TRIV \(the file holds surface\)"),
        ({"X": np.zeros(3)}, "have 3, 5 and 5 entries"),
        ({"TRIV": np.array([[1, 2, 2.5]])}, "surface.TRIV holds numbers that are no vertex ids"),
        ({"TRIV": np.array([[1, 2, 9]])}, "face 0 refers to vertex 8, but there are 5"),
        ({"TRIV": np.zeros((0, 3))}, "no faces"),
        ({"X": np.array([0, np.nan, 1, 1, 1])}, "first is vertex 1"),
        ({"X": "text"}, "not arrays of numbers"),
    ],
)
def test_bad_mat_files(tmp_path, changes, fault):
    path = mat(tmp_path / "x.mat", **changes)
    with pytest.raises(MeshError, match=fault) as error:
        load_mesh(path)
    assert str(path) in str(error.value)


def test_other_mat_files(tmp_path):
    scipy.io.savemat(tmp_path / "other.mat", {"dist": np.eye(2)})
    with pytest.raises(MeshError, match=r"other.mat: no surface.X, .*\(the file holds dist\)"):
        load_mesh(tmp_path / "other.mat")
    path = mat(tmp_path / "cut.mat")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(MeshError, match=r"cut\.mat: "):
        load_mesh(path)


def test_missing_files(tmp_path):
    write(tmp_path, "cat0.off", OFF)
    with pytest.raises(MeshError, match=r"cat_0\.off: no such file; did you mean cat0.off\?"):
        load_mesh(tmp_path / "cat_0.off")
    with pytest.raises(MeshError, match=r"zebra\.off: no such file$"):
        load_mesh(tmp_path / "zebra.off")
    with pytest.raises(MeshError, match=r"there is no folder .*nowhere either"):
        load_mesh(tmp_path / "nowhere" / "cat0.off")
    with pytest.raises(MeshError, match="is a folder, not a mesh file"):
        load_mesh(tmp_path)
    write(tmp_path, "dog.vert", VERT)
    with pytest.raises(MeshError, match=r"dog\.tri: no such file; dog\.vert needs it beside itself"):
        load_mesh(tmp_path / "dog.vert")


def test_bad_vert_and_tri(tmp_path):
    write(tmp_path, "a.vert", VERT)
    write(tmp_path, "a.tri", "1 2 4\n2 5\n")
    with pytest.raises(MeshError, match=r"a\.tri: line 2: expected face 1 of 2 \(3 numbers\), found '2 5'"):
        load_mesh(tmp_path / "a.vert")
    write(tmp_path, "a.tri", "1 2 4\n2 5 4 1\n")  # a quad: half of it would be lost
    with pytest.raises(MeshError, match=r"a\.tri: line 2: expected a triangle: 3 vertex ids and no more, found"):
        load_mesh(tmp_path / "a.tri")
    write(tmp_path, "a.tri", "")
    with pytest.raises(MeshError, match=r"a\.tri: the file is empty"):
        load_mesh(tmp_path / "a.vert")
    write(tmp_path, "a.tri", "1 2 4\n2 6 4\n")
    with pytest.raises(MeshError, match=r"a\.vert: face 1 refers to vertex 5"):
        load_mesh(tmp_path / "a.vert")


@pytest.mark.parametrize("ending", ["off", "obj", "ply"])
def test_saving_is_exact(tmp_path, ending):
    verts = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1e-7
    mesh = Mesh(verts, torch.tensor([[0, 1, 2], [5, 4, 3], [19, 0, 7]]))
    save_mesh(mesh, tmp_path / f"x.{ending}")
    back = load_mesh(tmp_path / f"x.{ending}")
    assert torch.equal(back.verts, mesh.verts)
    assert torch.equal(back.faces, mesh.faces)
    assert os.listdir(tmp_path) == [f"x.{ending}"]


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    verts=st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3), min_size=3, max_size=6),
    ending=st.sampled_from(["off", "obj", "ply"]),
)
def test_any_double_survives(tmp_path, verts, ending):
    mesh = Mesh.from_arrays(verts, [[0, 1, 2]])
    save_mesh(mesh, tmp_path / f"x.{ending}")
    assert torch.equal(load_mesh(tmp_path / f"x.{ending}").verts, mesh.verts)


def test_a_failed_save_leaves_nothing_and_keeps_the_old_file(tmp_path, monkeypatch):
    mesh = Mesh.from_arrays(VERTS, FACES)
    old = write(tmp_path, "x.off", "old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(MeshError, match=r"x\.off: cannot be written \(disk full\)"):
        save_mesh(mesh, old)
    assert os.listdir(tmp_path) == ["x.off"]
    assert old.read_text() == "old"


def test_where_saving_is_refused(tmp_path):
    mesh = Mesh.from_arrays(VERTS, FACES)
    with pytest.raises(MeshError, match=r"x\.stl: cannot write .stl; supported are .off, .obj, .ply"):
        save_mesh(mesh, tmp_path / "x.stl")
    with pytest.raises(MeshError, match=r"x\.off: cannot be written \(No such file or directory\)"):
        save_mesh(mesh, tmp_path / "none" / "x.off")
    (tmp_path / "d.off").mkdir()
    with pytest.raises(MeshError, match=r"d\.off: cannot be written \(Is a directory\)"):
        save_mesh(mesh, tmp_path / "d.off")
    assert os.listdir(tmp_path) == ["d.off"]


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        (OFF, True),
        (OFF.rstrip("\n"), True),
        (OFF.replace("1 1 .5", "-1e-3 +1. 5E-1"), True),
        (OFF.replace("\n", "\r\n"), False),
        (OFF.replace("9 9 9", "9 9 9 # far"), False),
        (OFF.replace("OFF\n", "OFF\n\n"), False),
        (OFF.replace("OFF\n", "OFF "), False),
        (OFF.replace("3 0 1 3\n", "4 0 1 4 3\n"), False),
        (OFF.replace("3 0 1 3", "3 0 1. 3"), False),
        (OFF.replace("9 9 9", "9 9 9 255"), False),
        (OFF.replace("9 9 9", "9 9 x"), False),
        (OFF.replace("9 9 9\n", ""), False),
        (OFF + "\n", False),
    ],
)
def test_the_quick_way_for_off_reads_what_the_slow_one_reads(tmp_path, text, plain):
    """It declines all but the usual files; what it takes, it reads the same."""
    path = write(tmp_path, "a.off", text)
    found = formats._plain_off(path)
    assert (found is not None) == plain
    if found is not None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(formats, "_plain_off", lambda path: None)
            slow = formats._read_off(path)
        for quick, wanted in zip(found, slow, strict=True):
            assert quick.dtype == wanted.dtype
            assert np.array_equal(quick, wanted)


def test_files_read_at_the_same_time_leave_the_filters_of_warnings_alone(tmp_path, monkeypatch):
    """If a second reader came in while the first is inside and left last, the first one's filters would stay."""
    path = tmp_path / "a.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    second_in, first_out, before, inside = Event(), Event(), list(warnings.filters), []
    real = np.fromstring

    def slowly(*given, **named):
        inside.append(get_ident())
        if len(inside) == 1:
            second_in.wait(0.3)
        elif inside[-1] != inside[0] and not second_in.is_set():
            second_in.set()
            first_out.wait(0.3)
        return real(*given, **named)

    def load(path):
        mesh = load_mesh(path)
        first_out.set()
        return mesh

    monkeypatch.setattr(np, "fromstring", slowly)
    with ThreadPoolExecutor(2) as pool:
        meshes = list(pool.map(load, [path, path]))
    assert [mesh.n_faces for mesh in meshes] == [1, 1]
    assert warnings.filters == before
