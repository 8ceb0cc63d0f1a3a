"""``torchqm data check``: its table, its JSON, its exit status."""

import json

import pytest
from references.folders import write_lines, write_mesh

from torchqm.cli.data import _MOST_ROWS
from torchqm.cli.main import build_parser, main
from torchqm.data.layouts import LAYOUTS


def faust(root):
    for number in (0, 80):
        write_mesh(root / f"off/tr_reg_{number:03d}.off")
        write_lines(root / f"corres/tr_reg_{number:03d}.vts", [6, 1, 2])
    return root


def test_a_good_folder(tmp_path, capsys):
    assert main(["data", "check", str(faust(tmp_path))]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f"{tmp_path}: layout vts"
    assert any("1-based (2 of 2 files have an id equal to the count" in line for line in out)
    assert "class  shapes  vertices  truth                          symmetry" in out
    assert "faust       2         6  points of a template (2 .vts)  none" in out
    assert out[-2:] == ["2 shapes in 1 class, train 1, test 1", "0 malformed, 0 missing, 1 note"]


def test_missing_and_malformed_give_status_one_and_are_in_the_table(tmp_path, capsys):
    faust(tmp_path)
    write_mesh(tmp_path / "off/tr_reg_001.off")
    write_lines(tmp_path / "corres/tr_reg_080.vts", [6, 9, 2])
    assert main(["data", "check", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    rows = [line.split(maxsplit=2) for line in out.splitlines() if line.startswith(("malformed", "missing"))]
    assert [row[:2] for row in rows] == [["malformed", "tr_reg_080"], ["missing", "tr_reg_001"]]
    assert "tr_reg_080.vts:2: vertex 9 is out of range" in rows[0][2]
    assert out.splitlines()[-1] == "1 malformed, 1 missing, 1 note"


def test_json_says_the_same(tmp_path, capsys):
    faust(tmp_path)
    (tmp_path / "off/tr_reg_000.off").write_text("OFF\n")
    assert main(["data", "check", str(tmp_path), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["layout"] == "vts"
    assert report["shapes"] == 2
    assert report["ok"] is False
    assert report["split"] == {"train": 1, "test": 1}
    assert report["classes"][0]["vertices"] == [6, 6]
    (fault,) = (problem for problem in report["problems"] if problem["severity"] == "malformed")
    assert fault["name"] == "tr_reg_000"
    assert fault["path"] == str(tmp_path / "off/tr_reg_000.off")


def test_full_reads_the_numbers(tmp_path, capsys):
    write_mesh(tmp_path / "a.off")
    text = (tmp_path / "a.off").read_text()
    (tmp_path / "a.off").write_text(text.replace("3 0 1 2", "3 0 1 9"))
    assert main(["data", "check", str(tmp_path)]) == 0
    assert main(["data", "check", str(tmp_path), "--full"]) == 1
    assert "refers to vertex 9" in capsys.readouterr().out


def test_a_long_list_is_cut_in_the_table_but_not_in_json(tmp_path, capsys):
    for number in range(_MOST_ROWS + 5):
        write_mesh(tmp_path / f"off/x{number}.off")
    write_lines(tmp_path / "corres/x0.vts", [1, 6])
    assert main(["data", "check", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert out.count("missing  ") == _MOST_ROWS + 1
    assert "and 4 more (--json has all)" in out
    main(["data", "check", str(tmp_path), "--json"])
    assert len(json.loads(capsys.readouterr().out)["problems"]) == _MOST_ROWS + 4


@pytest.mark.parametrize(("name", "message"), [("nowhere", "no such folder"), ("", "the folder is empty")])
def test_no_set_is_status_two(tmp_path, capsys, name, message):
    assert main(["data", "check", str(tmp_path / name)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert message in said.err
    assert said.err.count("\n") == 1


def test_the_creatures_are_a_set_too(capsys):
    assert main(["data", "check", "synthetic:kinds=ellipsoid;poses=2;verts=500;triangulation=shared"]) == 0
    out = capsys.readouterr().out
    assert "layout synthetic" in out
    assert "ellipsoid-0       2" in out


def test_help_explains_every_layout_and_the_status(capsys):
    with pytest.raises(SystemExit):
        build_parser().parse_args(["data", "check", "--help"])
    text = capsys.readouterr().out
    for layout in (*LAYOUTS, "synthetic:"):
        assert f" {layout}" in text
    assert "Exit status: 0 if nothing is missing or malformed" in text
