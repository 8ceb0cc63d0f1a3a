"""Mesh files of a folder: vertex counts, and what a quick and a full look find."""

import pytest
from references.folders import write_mesh

from torchqm.data.meshes import look_at_mesh, mesh_files, vertex_count
from torchqm.geometry import MeshError, load_mesh


@pytest.mark.parametrize("ending", [".off", ".obj", ".ply", ".mat", ".vert"])
def test_vertex_counts_are_those_of_the_mesh(tmp_path, ending):
    write_mesh(tmp_path / f"x{ending}", 7)
    assert vertex_count(tmp_path / f"x{ending}") == 7
    assert look_at_mesh(tmp_path / f"x{ending}") is None


@pytest.mark.parametrize("text", ["", "PLY\n", "OFF\nmany 2 0\n"])
def test_a_file_without_a_header_has_no_vertex_count(tmp_path, text):
    (tmp_path / "x.off").write_text(text)
    with pytest.raises(MeshError, match=r"x\.off"):
        vertex_count(tmp_path / "x.off")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t: t.rsplit("\n", 2)[0], "truncated"),
        (lambda t: t + "3 0 1 2\n", "declares 6 vertices"),
        (lambda t: t.replace("0.1", "x"), "expected vertex"),
        (lambda t: t.replace("6 4 0", "6 0 0"), "declares 6 vertices and 0 faces"),
        (lambda t: "", "empty"),
    ],
)
def test_a_quick_look_finds_what_is_wrong_with_a_file(tmp_path, edit, message):
    path = tmp_path / "x.off"
    write_mesh(path)
    path.write_text(edit(path.read_text()))
    said = look_at_mesh(path)
    assert said is not None
    assert message in said
    assert "x.off" in said


def test_only_a_full_look_reads_the_numbers_of_an_off_file(tmp_path):
    path = tmp_path / "x.off"
    write_mesh(path)
    path.write_text(path.read_text().replace("3 0 1 2", "3 0 1 9"))
    assert look_at_mesh(path) is None
    assert "refers to vertex 9" in str(look_at_mesh(path, full=True))
    with pytest.raises(MeshError):
        load_mesh(path)


def test_of_one_stem_the_first_ending_counts(tmp_path):
    for name in ("b10.off", "b2.off", "b2.obj", ".hidden.off", "notes.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "folder.off").mkdir()
    (tmp_path / "link.off").symlink_to("nowhere")
    assert list(mesh_files(tmp_path)) == ["b2", "b10", "link"]
    assert "link.off: no such file" in str(look_at_mesh(tmp_path / "link.off"))
    assert mesh_files(tmp_path)["b2"].suffix == ".off"
    assert mesh_files(tmp_path / "nowhere") == {}
