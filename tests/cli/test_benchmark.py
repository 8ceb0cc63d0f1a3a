"""torchqm benchmark: what is missing is run, after a kill, too; a pair that fails is a row; nothing is mixed."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from references.matchers import Scripted

from torchqm.cli import benchmark as command
from torchqm.cli.benchmark_help import DEFAULT_METHODS
from torchqm.cli.main import main
from torchqm.cli.processes import Failure
from torchqm.evaluate import report
from torchqm.matching.baselines import MATCHERS

ROOT = "synthetic:kinds=biped;verts=600;triangulation=shared"
DRAW = report._draw
NAMES = ["biped-0-pose0", "biped-0-pose1", "biped-0-pose2"]


@pytest.fixture
def out(tmp_path, monkeypatch):
    """The output folder; figures take most of the time and are drawn in one test only, pictures are small."""
    monkeypatch.delenv("TORCHQM_CACHE", raising=False)
    monkeypatch.setattr("torchqm.viz.charts.DPI", 60)
    monkeypatch.setattr("torchqm.viz.render.REFINE_BELOW", 0)
    monkeypatch.setattr(report, "_draw", lambda methods, path, title: path)
    return tmp_path / "out"


@pytest.fixture
def scripted(monkeypatch, tmp_path):
    """Puts a matcher of the tests under the name ``scripted``; gives the pairs that it was asked for."""
    log = tmp_path / "log.txt"

    def put(**options):
        monkeypatch.setitem(MATCHERS, "scripted", Scripted(log=str(log), **options))
        log.write_text("")
        return lambda: [tuple(line.split()) for line in log.read_text().splitlines()]

    return put


def benchmark(*words, out, jobs=1, worst=0):
    return main(["benchmark", *map(str, words), "--out", str(out), "--jobs", str(jobs), "--worst", str(worst)])


def results(out):
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in out.rglob("results/*/*.json")}


def runs(out):
    return json.loads((out / "run.json").read_text())["runs"]


def table(out):
    with (out / "pairs.csv").open() as file:
        return {(row["method"], row["source"], row["target"]): row for row in csv.DictReader(file)}


def test_a_run_writes_everything_and_a_second_runs_nothing(out, scripted, monkeypatch, capsys):
    monkeypatch.setattr(report, "_draw", DRAW)
    pairs = scripted()
    assert benchmark(ROOT, "--methods", "scripted", "--limit", 2, "--points", 10, out=out, worst=1) == 0
    text, err = capsys.readouterr()
    assert pairs() == [(NAMES[0], NAMES[1]), (NAMES[0], NAMES[2])]
    assert "2 pairs, 0 of 2 results are there" in text
    assert "[100 %] scripted, biped-0-pose0 → biped-0-pose2: " in err
    figures = [
        f"{name}.{kind}" for name in ("figure6_orbit", "figure10_map", "figure_plain") for kind in ("png", "svg")
    ]
    assert {p.name for p in out.iterdir() if p.is_file()} >= {*command.FILES, *figures}
    rows = table(out)
    assert list(rows) == [("scripted", NAMES[0], NAMES[1]), ("scripted", NAMES[0], NAMES[2])]
    for row in rows.values():  # vertex ids are the truth
        assert (float(row["plain_mean"]), float(row["orbit_mean"]), row["flip_map"]) == (0, 0, "false")
        assert (row["points"], row["seconds"], row["notes"], row["label"]) == ("10", "0.25", "a note", "direct")
    page = (out / "worst.html").read_text()
    assert page.count("<img ") == 1
    (picture,) = (out / "pictures").iterdir()
    assert picture.stat().st_size > 10_000
    before = results(out)
    monkeypatch.setattr(report, "_draw", lambda methods, path, title: path)
    assert benchmark(ROOT, "--methods", "scripted", "--limit", 2, "--points", 10, out=out, worst=1) == 0
    assert "2 of 2 results are there" in capsys.readouterr().out
    assert (results(out), len(pairs())) == (before, 2)
    (run,) = runs(out)  # a run with nothing to do writes none
    assert (run["results"], run["arguments"]["limit"], run["backend"]) == (2, 2, {"name": "local", "workers": 1})
    # one more pair, one more method: only these
    assert benchmark(ROOT, "--methods", "scripted,descriptors", "--limit", 3, "--points", 10, out=out) == 0
    assert "2 of 6 results are there" in capsys.readouterr().out
    assert len(pairs()) == 3
    assert results(out) | before == results(out)
    assert len(table(out)) == 6
    assert [row["results"] for row in runs(out)] == [2, 4]
    assert json.loads((out / "run.json").read_text())["arguments"]["limit"] == 3


def test_a_killed_run_is_gone_on_with(out, tmp_path, scripted, capsys):
    code = """
import os, signal, sys
from torchqm.cli.main import main
from torchqm.cli.processes import Failure
from torchqm.evaluate import report
from torchqm.matching.baselines import MATCHERS
from references.matchers import Scripted
import torchqm.benchmark.run as run

plain, count = run.measure_pair, 0

def measure_pair(*arguments):
    global count
    count += 1
    if count == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return plain(*arguments)

run.measure_pair = measure_pair
MATCHERS["scripted"] = Scripted(log=sys.argv[3])
main(["benchmark", sys.argv[1], "--methods", "scripted", "--points", "10", "--out", sys.argv[2], "--jobs", "1"])
"""
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, "-c", code, ROOT, str(out), str(tmp_path / "log.txt")]
    run = subprocess.run(words, capture_output=True, timeout=120, env=os.environ | {"PYTHONPATH": path})
    assert run.returncode == -signal.SIGKILL, run.stderr
    before = results(out)
    assert len(before) == 2
    assert not (out / "pairs.csv").exists()
    assert [row["results"] for row in runs(out)] == [None]
    half = next(out.glob("results/*")) / ".x.json.abc.part"  # what a kill in the middle of writing leaves
    half.write_text("{")
    pairs = scripted()
    assert benchmark(ROOT, "--methods", "scripted", "--points", 10, out=out) == 0
    assert "2 of 6 results are there" in capsys.readouterr().out
    assert len(pairs()) == 4
    assert [row["results"] for row in runs(out)] == [None, 4]
    assert len(table(out)) == 6
    assert results(out) | before == results(out)  # what was there was not written again
    assert not half.exists()


def test_an_interruption_keeps_what_is_done(out, scripted, monkeypatch, capsys):
    scripted()
    import torchqm.benchmark.run as run

    plain, calls = run.measure_pair, []

    def measure_pair(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return plain(*arguments)

    monkeypatch.setattr(run, "measure_pair", measure_pair)
    assert benchmark(ROOT, "--methods", "scripted", "--points", 10, out=out) == 130
    assert "interrupted; 1 of 6 results are in" in capsys.readouterr().err
    assert benchmark(ROOT, "--methods", "scripted", "--points", 10, "--report", out=out) == 0
    assert len(table(out)) == 1  # a report of what is there


def test_a_pair_that_fails_is_a_row_with_its_reason(out, scripted, capsys):
    pairs = scripted(fails=NAMES[1])
    words = (ROOT, "--methods", "scripted", "--limit", 2, "--points", 10)
    assert benchmark(*words, out=out, worst=0) == 1
    text, err = capsys.readouterr()
    assert "* scripted, biped-0-pose0 → biped-0-pose1: no map \\| <today>" in text
    assert "pose1 failed: " in err
    rows = table(out)
    assert rows["scripted", NAMES[0], NAMES[1]]["reason"] == "no map | <today>"
    assert rows["scripted", NAMES[0], NAMES[1]]["plain_mean"] == ""
    assert float(rows["scripted", NAMES[0], NAMES[2]]["plain_mean"]) == 0
    assert "no map | &lt;today&gt;" in (out / "worst.html").read_text()
    assert benchmark(*words, out=out) == 1
    assert len(pairs()) == 2
    assert benchmark(*words, "--retry", out=out) == 1
    assert pairs()[2:] == [(NAMES[0], NAMES[1])]


def test_a_process_that_dies_is_a_row_and_the_others_are_done(out, scripted, monkeypatch):
    scripted()
    plain = command.in_processes

    def in_processes(work, tasks, jobs):  # what a dead process comes to, see test_processes
        if not tasks:
            return
        for number, result in plain(work, tasks[1:], 1):
            yield number + 1, result
        yield 0, Failure("its process died (out of memory, or killed)")

    monkeypatch.setattr(command, "in_processes", in_processes)
    words = (ROOT, "--methods", "scripted", "--limit", 2, "--points", 10)
    assert benchmark(*words, out=out) == 1
    rows = table(out)
    assert len(rows) == 2
    reasons = {key[2]: row["reason"] for key, row in rows.items() if row["reason"]}
    assert reasons == {NAMES[1]: "its process died (out of memory, or killed)"}
    monkeypatch.undo()
    monkeypatch.setattr(report, "_draw", lambda methods, path, title: path)
    scripted()
    assert benchmark(*words, "--retry", out=out) == 0


def test_results_of_other_parameters_stay_and_are_not_mixed(out, scripted):
    words = (ROOT, "--methods", "scripted", "--limit", 1)
    scripted()
    assert benchmark(*words, "--points", 10, out=out) == 0
    first = results(out)
    (row,) = table(out).values()
    assert float(row["plain_mean"]) == 0
    scripted(shift=7)  # other options of the method
    assert benchmark(*words, "--points", 10, out=out) == 0
    (row,) = table(out).values()
    assert float(row["plain_mean"]) > 0.05
    assert benchmark(*words, "--points", 12, out=out) == 0  # another option of the run
    (row,) = table(out).values()
    assert row["points"] == "12"
    assert len(results(out)) == 3
    assert results(out) | first == results(out)
    pairs = scripted()
    assert benchmark(*words, "--points", 10, out=out) == 0  # the first again: still there
    assert pairs() == []


def test_a_changed_shape_is_run_again(tmp_path, out, scripted):
    from references import shapes

    from torchqm.geometry import save_mesh

    root = tmp_path / "set"
    root.mkdir()
    mesh = shapes.blob(2, 2).mesh
    for number in range(2):
        save_mesh(mesh, root / f"a{number}.off")
    words = (root, "--methods", "scripted", "--pairs", "all", "--points", 10)
    pairs = scripted()
    assert benchmark(*words, out=out) == 0
    assert len(pairs()) == 2
    save_mesh(mesh.moved(2.0 * mesh.verts), root / "a1.off")
    assert benchmark(*words, out=out) == 0
    assert len(pairs()) == 4


def test_names_with_a_slash(tmp_path, out, scripted):
    from references.folders import write_lines
    from references.shapes import blob

    from torchqm.geometry import save_mesh

    root, mesh = tmp_path / "DT4D_r", blob(2, 2).mesh
    for pose in ("PoseA", "PoseB"):
        (root / "off" / "crypto").mkdir(parents=True, exist_ok=True)
        save_mesh(mesh, root / "off" / "crypto" / f"{pose}.off")
        write_lines(root / "corres" / "crypto" / f"{pose}.vts", range(1, mesh.n_verts + 1))
    for part in ("train", "test"):
        write_lines(root / f"{part}.txt", ["crypto/PoseA", "crypto/PoseB"])
    scripted()
    assert benchmark(root, "--methods", "scripted", "--points", 10, out=out, worst=1) == 0
    assert ("scripted", "crypto/PoseA", "crypto/PoseB") in table(out)
    assert {Path(name).name for name in results(out)} == {
        "crypto%2FPoseA+crypto%2FPoseB.json",
        "crypto%2FPoseB+crypto%2FPoseA.json",
    }
    (picture,) = (out / "pictures").iterdir()
    assert picture.name.replace("%", "%25").replace("+", "%2B") in (out / "worst.html").read_text()


def test_bad_input(tmp_path, out, scripted, capsys):
    scripted()
    absent, mixed = tmp_path / "absent.txt", tmp_path / "mixed.txt"
    absent.write_text(f"{NAMES[0]} {NAMES[1]}\n{NAMES[0]} biped-0-pose9\n")
    mixed.write_text("biped-0-pose0 octopus-0-pose0\n")
    both = "synthetic:kinds=biped,octopus;verts=600"
    for words, text in (
        ([tmp_path / "gone"], "gone: no such folder"),
        (["synthetic:kinds=cow"], "kinds is 'cow'"),
        ([ROOT, "--methods", "scripted,magic"], "method 'magic': unknown; allowed are quotient, "),
        ([ROOT, "--methods", "scripted,scripted"], "method 'scripted' is given twice"),
        ([ROOT, "--methods", ","], "methods: at least one is needed"),
        ([ROOT, "--pairs", absent], "absent.txt:2: there is no shape 'biped-0-pose9'"),
        ([ROOT, "--pairs", "scb"], "no pair in"),
        ([both, "--pairs", mixed], "no truth from biped-0-pose0 to octopus-0-pose0"),
        ([ROOT, "--methods", "published:BlendedMap"], "synthetic:kinds=biped;"),
        ([ROOT, "--points", "landmarks"], "ships no landmarks"),
        ([ROOT, "--report", "--methods", "scripted"], "no result is there yet"),
    ):
        assert benchmark(*words, out=out) == 2, words
        err = capsys.readouterr().err
        assert text in err
        assert err.count("\n") == 1
    file = tmp_path / "file"
    file.write_text("")
    assert benchmark(ROOT, "--methods", "scripted", out=file) == 2
    assert "the output folder cannot be used" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        benchmark(ROOT, "--limit", 0, out=out)


def test_a_result_cut_short_is_named_and_the_others_are_kept(out, scripted, capsys):
    pairs = scripted()
    words = (ROOT, "--methods", "scripted", "--limit", 2, "--points", 10)
    assert benchmark(*words, out=out) == 0
    cut, kept = sorted(out.rglob("results/*/*.json"))
    whole = cut.read_bytes()
    for content, text in ((whole[: len(whole) // 2], "damaged or cut short"), (b"{}", "no result of a pair")):
        cut.write_bytes(content)
        capsys.readouterr()
        assert benchmark(*words, out=out) == 2
        err = capsys.readouterr().err
        assert f"torchqm: error: {cut}" in err
        assert text in err
        assert json.loads(kept.read_text())["status"] == "done"
    cut.unlink()
    assert benchmark(*words, out=out) == 0
    assert len(pairs()) == 3


def test_two_runs_do_not_share_a_folder(out, scripted, capsys):
    from filelock import FileLock

    scripted()
    out.mkdir()
    with FileLock(out / ".lock"):
        assert benchmark(ROOT, "--methods", "scripted", out=out) == 2
    assert "another run is writing there" in capsys.readouterr().err


def test_the_help_names_all_methods(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["benchmark", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in MATCHERS)
    assert set(DEFAULT_METHODS.split(",")) <= set(MATCHERS)
