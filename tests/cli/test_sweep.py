import csv
import importlib.util
import io
import json
from pathlib import Path

import pytest
import yaml

from torchqm.cli import sweep as module
from torchqm.cli import sweep_results
from torchqm.cli.console import Progress, UserError
from torchqm.cli.sweep import main, run_sweep
from torchqm.cli.sweep_plan import Sweep

pytestmark = pytest.mark.usefixtures("plain_curves")

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "sweep.py"


def plan(**more):
    return Sweep(Path("a.yaml"), **({"seeds": (0, 1), "grid": {"model.k": [10, 20]}} | more))


def never(run):
    raise AssertionError(f"{run.name} is trained")


def progress(stream, seconds=10.0):
    """A clock that each look at it moves on."""
    ticks = iter(range(10**6))
    return Progress(stream, live=False, clock=lambda: seconds * next(ticks))


def test_finished_runs_are_skipped_and_the_one_that_was_stopped_begins_anew(tmp_path):
    ran = []

    def train(run):
        assert not (tmp_path / run.name / "left").exists()
        (tmp_path / run.name / "left").touch()
        ran.append(run.name)
        if len(ran) == 3:
            raise KeyboardInterrupt
        return {"test_orbit_error": float(len(ran))}

    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan(), tmp_path, progress(io.StringIO()), train)
    said = io.StringIO()
    rows = run_sweep(plan(), tmp_path, progress(said), train)
    assert ran == ["k=10-seed=0", "k=20-seed=0", "k=10-seed=1", "k=10-seed=1", "k=20-seed=1"]
    assert [row["test_orbit_error"] for row in rows] == [1.0, 2.0, 4.0, 5.0]
    lines = said.getvalue().splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("[ 50 %] k=10-seed=1: ")
    assert "s left" in lines[0]
    assert run_sweep(plan(), tmp_path, progress(said), never) == rows


def test_a_config_that_was_changed_is_not_mixed_with_what_it_was(tmp_path):
    (tmp_path / "model.yaml").write_text("k: 40")
    (tmp_path / "a.yaml").write_text("model: model.yaml\ndata: a.yaml")  # that it names itself does no harm
    sweep = Sweep(tmp_path / "a.yaml", (0,))
    out = tmp_path / "out"
    run_sweep(sweep, out, progress(io.StringIO()), lambda run: {"test_orbit_error": 0.5})
    assert run_sweep(sweep, out, progress(io.StringIO()), never)[0]["test_orbit_error"] == 0.5
    (tmp_path / "model.yaml").write_text("k: 60")  # the file itself is the same
    with pytest.raises(UserError, match=r"seed=0: has a run of a config that was changed since \(result.json\)"):
        run_sweep(sweep, out, progress(io.StringIO()), never)


def test_runs_of_another_version_are_not_mixed_with_those_of_this_one(tmp_path, monkeypatch):
    run_sweep(plan(), tmp_path, progress(io.StringIO()), lambda run: {"test_orbit_error": 0.5})
    assert len(run_sweep(plan(), tmp_path, progress(io.StringIO()), never)) == 4
    monkeypatch.setattr(sweep_results, "__version__", "9.9.9")
    with pytest.raises(UserError, match=r"k=10-seed=0: has a run of torchqm .* \(result.json\), this is 9.9.9; .*del"):
        run_sweep(plan(), tmp_path, progress(io.StringIO()), never)
    path = tmp_path / "k=10-seed=0" / "result.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "torchqm"}))
    with pytest.raises(UserError, match=r"has a run of an earlier torchqm that did not say so \(result.json\)"):
        run_sweep(plan(), tmp_path, progress(io.StringIO()), never)
    path.write_text('{"config"')
    with pytest.raises(UserError, match=r"result.json: damaged .*delete the folder"):
        run_sweep(plan(), tmp_path, progress(io.StringIO()), never)


def test_what_is_wrong_in_a_sweep_is_told_in_one_line_with_its_place(tmp_path, capsys):
    (tmp_path / "a.yaml").write_text("data: {root: 'synthetic:'}\n")
    cases = {
        "config: none.yaml": "s.yaml: config: File does not exist: ",
        "config: 3": "s.yaml: config: 3 given, expected the name of a YAML file",
        "config: a.yaml\nsetups: {half: {model.setpu: quotient}}":
            "s.yaml: setups.half: model.setpu: no such option; the nearest is --model.setup",
        "config: a.yaml\ngrid: {model.k: [ten]}": "s.yaml: grid: model.k: 'ten' given, expected int",
        "config: a.yaml\nsetups: {fm: {model.setup: functional_map, model.supervision: orbit}}":
            "run fm-seed=0: model.truth_form: 'spectral' given, which with supervision 'orbit' needs an even block",
        "config: a.yaml\nsetups: {half: {model.tau: -1}}": "s.yaml: setups.half: model.tau: -1.0 given",
    }  # fmt: skip
    for text, message in cases.items():
        (tmp_path / "s.yaml").write_text(text)
        assert main([str(tmp_path / "s.yaml"), "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("sweep: error: ")
        assert message in line
    (tmp_path / "s.yaml").write_text("config: a.yaml")
    assert main([str(tmp_path / "s.yaml"), "--set", "model.setpu=quotient"]) == 2
    assert "error: --model.setpu: no such option" in capsys.readouterr().err  # not of the file
    for words, message in (
        (["--grid", "model.k="], "model.k: no value given"),
        (["--set", "model.k=[1"], "which is no YAML"),
        (["--seeds", "-1"], "argument --seeds"),
    ):
        with pytest.raises(SystemExit):
            main(["--config", str(tmp_path / "a.yaml"), *words])
        assert message in capsys.readouterr().err


def test_a_run_that_fails_is_in_the_table_and_the_others_go_on(tmp_path):
    def train(run):
        if run.name == "k=20-seed=0":
            raise UserError("the loss is nan\nat the pairs a -> b")
        return {"test_orbit_error": 0.5 + run.seed}

    rows = run_sweep(plan(), tmp_path, progress(io.StringIO()), train)
    assert [row["status"] for row in rows] == ["done", "failed: the loss is nan at the pairs a -> b", "done", "done"]
    again = []
    run_sweep(plan(), tmp_path, progress(io.StringIO()), lambda run: again.append(run.name) or train(run))
    assert again == ["k=20-seed=0"]  # what failed is tried again, and nothing else


def test_folders_with_something_else_are_left_alone(tmp_path):
    run_sweep(plan(), tmp_path, progress(io.StringIO()), lambda run: {})
    with pytest.raises(UserError, match=r"k=10-seed=0: has a run with other arguments \(result.json\)"):
        run_sweep(plan(options={"model.lr": 1.0}), tmp_path, progress(io.StringIO()), never)
    (tmp_path / "other" / "k=20-seed=0").mkdir(parents=True)
    with pytest.raises(UserError, match=r"k=20-seed=0: exists, but is no run of a sweep"):
        run_sweep(plan(), tmp_path / "other", progress(io.StringIO()), never)


def test_a_sweep_from_the_command_line(tmp_path, capsys):
    names = [f"ellipsoid-0-pose{pose}" for pose in range(6)]
    (tmp_path / "split.yaml").write_text(
        yaml.safe_dump({"train": names[:2], "validation": names[2:4], "test": names[4:]})
    )
    config = {
        "model": {"k": 8, "channels": 6, "width": 8, "signature": 8},
        "data": {
            "root": "synthetic:kinds=ellipsoid;poses=6;verts=500;triangulation=shared",
            "split": str(tmp_path / "split.yaml"),
        },
        "trainer": {"max_epochs": 1, "accelerator": "cpu", "num_sanity_val_steps": 0},
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    given = ["--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out"), "--seeds", "1"]
    grid = ["--grid", "model.setup=quotient,functional_map", "--set", "pictures.every=0"]
    assert main([*given, "--grid", "model.setpu=quotient"]) == 2
    assert "--model.setpu: no such option; the nearest is --model.setup" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*given, *grid]) == 0
    out = capsys.readouterr().out
    assert (tmp_path / "out" / "sweep.md").read_text() in out
    with (tmp_path / "out" / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["model.setup"], row["seed"]) for row in rows] == [("quotient", "1"), ("functional_map", "1")]
    for row in rows:
        folder = tmp_path / "out" / row["run"]
        with (folder / "test" / "metrics.csv").open() as file:
            (tested,) = csv.DictReader(file)
        assert float(row["test_orbit_error"]) == pytest.approx(float(tested["test_orbit_error"]))
        assert json.loads((folder / "result.json").read_text())["status"] == "done"
        written = yaml.safe_load((folder / "config.yaml").read_text())
        assert written["model"]["setup"] == row["model.setup"]
        assert written["seed_everything"] == int(row["seed"])


def test_the_script_is_the_command():
    spec = importlib.util.spec_from_file_location("sweep_script", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.main is module.main
