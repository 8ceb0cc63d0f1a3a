"""The registrations of FAUST as first published."""

import pytest
from references.folders import found, write_mesh

from torchqm.data.layouts import open_shapes


@pytest.mark.parametrize("place", [".", "registrations", "training/registrations", "MPI-FAUST/training/registrations"])
def test_registrations_agree_across_people(tmp_path, place):
    for number in (0, 79, 80, 99):
        write_mesh(tmp_path / place / f"tr_reg_{number:03d}.ply")
    write_mesh(tmp_path / place / "tr_scan_000.ply", 9)
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "faust-registrations"
    assert shapes.names == ["tr_reg_000", "tr_reg_079", "tr_reg_080", "tr_reg_099"]
    assert shapes.truth("tr_reg_000", "tr_reg_099").points.tolist() == list(range(6))
    assert shapes.split() == {"train": ["tr_reg_000", "tr_reg_079"], "test": ["tr_reg_080", "tr_reg_099"]}
    assert found(shapes) == {"FAUST": "4 registrations; FAUST has 100"}
    assert shapes.symmetry("tr_reg_000") is None


def test_another_vertex_count_and_a_cut_file_are_malformed(tmp_path):
    for number, count in ((0, 6), (1, 6), (2, 7)):
        write_mesh(tmp_path / f"tr_reg_{number:03d}.ply", count)
    whole = (tmp_path / "tr_reg_000.ply").read_bytes()
    (tmp_path / "tr_reg_003.ply").write_bytes(whole[:-20])
    shapes = open_shapes(tmp_path)
    malformed = found(shapes, "malformed")
    assert set(malformed) == {"tr_reg_002", "tr_reg_003"}
    assert "7 vertices where class 'faust' has 6" in malformed["tr_reg_002"]
    assert "tr_reg_003.ply" in malformed["tr_reg_003"]
