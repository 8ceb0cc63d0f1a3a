"""torchqm prepare: every shape of a folder in the cache, after a kill, too; what fails is named."""

import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from references import shapes
from references.shapes import basis_of

from torchqm.cli.main import main
from torchqm.cli.prepare import DEFAULT_K, FOLDER
from torchqm.geometry import load_mesh, save_mesh
from torchqm.matching import MatchParameters
from torchqm.spectral import cache, cached_basis

NAMES = ["a1", "a2", "a3", "a10"]


@pytest.fixture
def root(tmp_path, monkeypatch):
    """Four small shapes of different content."""
    monkeypatch.delenv(cache.CACHE_VARIABLE, raising=False)
    folder = tmp_path / "set"
    folder.mkdir()
    mesh = shapes.blob(1, 2).mesh
    for number, name in enumerate(NAMES):
        save_mesh(mesh.moved(mesh.verts * (1 + number)), folder / f"{name}.off")
    return folder


@pytest.fixture
def solved(monkeypatch):
    """Labels of the shapes whose eigenpairs were computed."""
    labels, plain = [], cache.eigenbasis_and_note

    def eigenbasis(operator, k, name):
        labels.append(os.path.basename(name))
        return plain(operator, k, name)

    monkeypatch.setattr(cache, "eigenbasis_and_note", eigenbasis)
    return labels


def prepare(*words):
    return main(["prepare", *map(str, words), "--jobs", "1"])


def rows(text):
    """The table: words of each row, and what is said at its end."""
    lines = text.split("\n\n")[0].splitlines()[1:]
    return {line.split()[0]: (line.split()[1:5], " ".join(line.split()[5:])) for line in lines}


def kept(folder):
    return {p.name: p.stat().st_mtime_ns for p in folder.glob("*.npz")}


def test_all_shapes_are_kept_and_a_second_run_computes_nothing(root, solved, capsys):
    assert prepare(root, "--k", 9) == 0
    out, err = capsys.readouterr()
    assert list(rows(out)) == NAMES
    for cells, text in rows(out).values():
        assert (cells[:3], text) == (["162", "9", "cotan"], "computed")
    assert "4 shapes: 4 computed" in out
    assert f"--cache {root / FOLDER}" in out
    assert re.search(r"\[ 50 %\] a2: [\d.]+ s, about \d+ s left\n", err)
    for name in NAMES:
        mesh = load_mesh(root / f"{name}.off")
        basis = cached_basis(mesh, 9, cache_dir=root / FOLDER)
        assert basis.report.outcome == "read"
        np.testing.assert_allclose(basis.evals, basis_of(mesh, 9).evals, atol=1e-9)
    before = kept(root / FOLDER)
    assert solved == [f"{name}.off" for name in NAMES]
    assert prepare(root, "--k", 8) == 0
    out, err = capsys.readouterr()
    assert {text for _, text in rows(out).values()} == {"in the cache"}
    assert err == ""
    assert (kept(root / FOLDER), len(solved)) == (before, 4)


def test_a_killed_run_is_gone_on_with_in_several_processes(root, capsys):
    code = """
import os, signal, sys
from torchqm.cli.main import main
from torchqm.spectral import cache

plain, count = cache.eigenbasis_and_note, 0

def eigenbasis(*arguments):
    global count
    count += 1
    if count == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return plain(*arguments)

cache.eigenbasis_and_note = eigenbasis
main(["prepare", sys.argv[1], "--k", "9", "--jobs", "1"])
"""
    run = subprocess.run([sys.executable, "-c", code, str(root)], capture_output=True, timeout=120)
    assert run.returncode == -signal.SIGKILL
    before = kept(root / FOLDER)
    assert len(before) == 2
    assert main(["prepare", str(root), "--k", "9", "--jobs", "2"]) == 0
    out, err = capsys.readouterr()
    done = {name: text for name, (_, text) in rows(out).items()}
    assert done == {"a1": "in the cache", "a2": "in the cache", "a3": "computed", "a10": "computed"}
    assert {re.sub(r"\[.*\] (\w+): .*", r"\1", line) for line in err.splitlines()} == {"a3", "a10"}
    after = kept(root / FOLDER)
    assert len(after) == 4
    assert after | before == after  # what was there was not written again


def test_an_interruption_keeps_what_is_done(root, monkeypatch, capsys):
    plain = cache.eigenbasis_and_note

    def eigenbasis(operator, k, name):
        if name.endswith("a3.off"):
            raise KeyboardInterrupt
        return plain(operator, k, name)

    monkeypatch.setattr(cache, "eigenbasis_and_note", eigenbasis)
    assert prepare(root, "--k", 9) == 130
    assert "interrupted; 2 of 4 shapes are in" in capsys.readouterr().err
    assert len(kept(root / FOLDER)) == 2


def test_a_shape_that_fails_is_a_row_and_the_rest_is_done(root, capsys):
    (root / "a2.off").write_text("OFF\n3 1 0\n0 0 0\n")
    save_mesh(shapes.icosphere(0), root / "tiny.off")
    assert prepare(root, "--k", 20) == 1
    out, err = capsys.readouterr()
    table = rows(out)
    assert table["a2"][0] == ["-"] * 4
    assert re.match(r"failed: .*a2\.off: truncated after line 3", table["a2"][1])
    assert re.match(r"failed: .*tiny\.off: 20 eigenpairs asked for, but the mesh has 12 vertices", table["tiny"][1])
    assert [table[name][1] for name in ("a1", "a3", "a10")] == ["computed"] * 3
    assert "5 shapes: 3 computed, 2 failed" in out
    assert "] a2 failed: " in err
    assert len(kept(root / FOLDER)) == 3


def test_a_damaged_entry_is_named_and_made_anew(root, solved, capsys):
    prepare(root, "--k", 9)
    path = cached_basis(load_mesh(root / "a3.off"), 9, cache_dir=root / FOLDER).report.path
    path.write_bytes(path.read_bytes()[:1000])
    capsys.readouterr()
    assert prepare(root, "--k", 9) == 0
    out, err = capsys.readouterr()
    assert rows(out)["a3"][1] == "computed in place of a damaged entry"
    assert f"torchqm: warning: {path}: damaged or foreign" in err
    assert re.search(r"\[ 5\d %\] a3: ", err)  # of the work that is left: one more may have to be computed
    assert [rows(out)[name][1] for name in ("a1", "a2", "a10")] == ["in the cache"] * 3
    assert solved == ["a1.off", "a2.off", "a3.off", "a10.off", "a3.off"]


def test_an_entry_that_cannot_be_written_is_a_failure(root, monkeypatch, capsys):
    def full(path, entry, name):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache, "write_entry", full)
    assert prepare(root, "--k", 9) == 1
    assert "failed: OSError: " in capsys.readouterr().out


def test_the_place_is_the_option_else_the_variable_else_the_root(root, tmp_path, monkeypatch):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "variable"))
    assert prepare(root, "--k", 5, "--cache", tmp_path / "new" / "option") == 0
    assert len(kept(tmp_path / "new" / "option")) == 4
    assert prepare(root, "--k", 5) == 0
    assert len(kept(tmp_path / "variable")) == 4
    assert not (root / FOLDER).exists()


def test_the_default_number_is_that_of_match_and_fits_small_shapes(root, capsys):
    assert MatchParameters().k_max == DEFAULT_K
    assert prepare(root) == 0
    assert {cells[1] for cells, _ in rows(capsys.readouterr().out).values()} == {"81"}  # half of 162, as match does


def test_the_laplacian_is_chosen(root, capsys):
    assert prepare(root, "--k", 5, "--laplacian", "robust") == 0
    assert {cells[2] for cells, _ in rows(capsys.readouterr().out).values()} == {"robust"}
    assert all("-robust-" in name for name in kept(root / FOLDER))


def test_bad_input(root, tmp_path, capsys):
    for words, text in (
        ([tmp_path / "gone"], "gone: no such folder"),
        ([root, "--cache", root / "a1.off"], "a1.off: the cache cannot be made there"),
        (["synthetic:"], "is no folder, so say where the cache goes"),
    ):
        assert prepare(*words) == 2
        assert text in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        prepare(root, "--k", 0)
    assert stop.value.code == 2


@pytest.mark.parametrize(("readable", "status"), [(False, 1), (True, 0)])
def test_a_mesh_that_the_set_cannot_use_is_said(tmp_path, monkeypatch, capsys, readable, status):
    """Left out of the set, it would otherwise be missed by nobody."""
    monkeypatch.delenv(cache.CACHE_VARIABLE, raising=False)
    for number in (0, 1, 2):
        save_mesh(shapes.blob(1, 1 if number == 1 else 2).mesh, tmp_path / f"tr_reg_00{number}.ply")
    if not readable:
        (tmp_path / "tr_reg_001.ply").write_text("no mesh")
    assert prepare(tmp_path, "--k", "9") == status
    out, err = capsys.readouterr()
    assert "2 shapes" in out
    assert (
        "tr_reg_001 is left out: 42 vertices where class" if readable else "tr_reg_001 is left out: not a PLY"
    ) in err
