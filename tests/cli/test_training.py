"""The commands `torchqm fit` and `torchqm test`, as a user gives them."""

import subprocess
import sys
from pathlib import Path

import pytest
import pytorch_lightning
import torch
import yaml

from torchqm.cli.learn import evaluate
from torchqm.cli.main import build_parser, main
from torchqm.data import open_shapes
from torchqm.geometry import save_mesh
from torchqm.learn import MatchModule

QUICK = Path(__file__).resolve().parents[2] / "configs" / "experiment" / "quick.yaml"
ROOT = "synthetic:kinds=ellipsoid;poses=6;verts=500;triangulation=shared"
VERSION = {"pytorch-lightning_version": pytorch_lightning.__version__}
SMALL = {"k": 8, "channels": 6, "width": 8, "signature": 8, "setup": "quotient"}


def config(folder, **more):
    """A run of seconds: two pairs, to and fro, to train on, and as many to validate and to test."""
    names = [f"ellipsoid-0-pose{pose}" for pose in range(6)]
    split = folder / "split.yaml"
    split.write_text(yaml.safe_dump({"train": names[:2], "validation": names[2:4], "test": names[4:]}))
    values = {
        "model": dict(SMALL),
        "data": {"root": ROOT, "split": str(split), "batch_size": 2},
        "trainer": {
            "max_epochs": 2,
            "accelerator": "cpu",
            "enable_progress_bar": False,
            "num_sanity_val_steps": 0,
            "log_every_n_steps": 1,
            "logger": {
                "class_path": "torchqm.learn.logger.RunLogger",
                "init_args": {"save_dir": str(folder), "version": "run"},
            },
        },
    }
    for key, value in more.items():
        group, name = key.split("__")
        values.setdefault(group, {})[name] = value
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def creature(verts=500):
    shapes = open_shapes(f"synthetic:kinds=ellipsoid;verts={verts};triangulation=shared")
    return shapes.mesh(shapes.names[0])


def error_of(capsys, *argv):
    assert main(list(argv)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("torchqm: error: ")]
    return line.removeprefix("torchqm: error: ")


def test_everything_after_the_command_is_passed_on():
    given = ["--config", "a.yaml", "stray", "--help", "--data.root=x", "-c"]
    for command in ("fit", "test"):
        assert build_parser().parse_args([command, *given]).arguments == given


def test_only_the_commands_themselves_load_lightning():
    code = (
        "import sys; from torchqm.cli.main import main\n"
        "try: main(sys.argv[1:])\nexcept SystemExit as stop: status = stop.code\n"
        "heavy = {'torch', 'pytorch_lightning', 'jsonargparse'} & {n.split('.')[0] for n in sys.modules}\n"
        "print('LOADED', status, sorted(heavy))"
    )
    for words, loaded in ((["--help"], "LOADED 0 []"), (["match", "--help"], "LOADED 0 []")):
        run = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
        assert run.stdout.splitlines()[-1] == loaded


def test_help_of_the_command_is_that_of_its_options(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["fit", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: torchqm")
    assert "--model.setup" in text
    assert "--pictures.every" in text


def test_a_run_folder_has_pictures_curves_events_and_metrics(tmp_path, capsys):
    assert main(["fit", "--config", str(config(tmp_path)), "--pictures.every", "2"]) == 0
    run = tmp_path / "run"
    kinds = {path.name.split(".")[0] if "tfevents" in path.name else path.name for path in run.iterdir()}
    wanted = {"config.yaml", "versions.json", "metrics.csv", "curves.png", "pictures", "checkpoints", "events"}
    assert wanted <= kinds
    (picture,) = (run / "pictures").iterdir()
    assert picture.name == "epoch-0002-ellipsoid-0-pose2-to-ellipsoid-0-pose3.png"
    assert {path.name.split("-")[0] for path in (run / "checkpoints").iterdir()} == {"best", "last.ckpt"}
    assert main(["test", str(run), "--trainer.logger.init_args.version", "tested"]) == 0
    assert "test_orbit_error" in (tmp_path / "tested" / "metrics.csv").read_text()


def test_bad_keys_values_and_roots_are_one_line(tmp_path, capsys):
    given = str(config(tmp_path))
    assert error_of(capsys, "fit", "--config", given, "--model.lrr", "3") == (
        "--model.lrr: no such option; the nearest is --model.lr"
    )
    assert error_of(capsys, "fit", "--config", given, "--model.lr", "fast") == (
        "--model.lr: 'fast' given, expected float"
    )
    assert error_of(capsys, "fit", "--config", given, "--trainer.logger.init_args.save_di", "x") == (
        "--trainer.logger.init_args.save_di: torchqm.learn.logger.RunLogger has no such argument; "
        "the nearest is save_dir"
    )
    assert error_of(capsys, "fit", "--config", given, "--model.setup", "half").startswith(
        "--model.setup: 'half' given, allowed"
    )
    (tmp_path / "empty").mkdir()
    assert error_of(capsys, "fit", "--config", given, "--data.root", str(tmp_path / "empty")).startswith(
        f"{tmp_path / 'empty'}: the folder is empty"
    )
    assert not (tmp_path / "run").exists()
    for key, line in (("model__lrr", "model.lrr: no such key; the nearest is model.lr"),
                      ("modle__lr", "modle.lr: no such key; the nearest is model.lr")):  # fmt: skip
        path = config(tmp_path, **{key: 0.1})
        assert error_of(capsys, "fit", "--config", str(path)) == f"{path}: {line}"
    assert error_of(capsys, "test", str(tmp_path / "empty")).startswith(f"{tmp_path / 'empty'}: no folder of a run")


def test_checkpoints_that_cannot_be_used_are_one_line_of_fit_and_test(tmp_path, capsys):
    given = str(config(tmp_path))
    module = MatchModule(**{**SMALL, "channels": 7, "lr": 0.25})
    content = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams)} | VERSION
    wide, cut, foreign = (str(tmp_path / f"{name}.ckpt") for name in ("wide", "cut", "foreign"))
    torch.save(content, wide)
    Path(cut).write_bytes(Path(wide).read_bytes()[:500])
    torch.save({"state_dict": {}, "hyper_parameters": {"depth": 1}}, foreign)
    for path, text in (
        ("none.ckpt", "none.ckpt: no such file"),
        ("last", "last: no such file"),  # Lightning would look for one
        (cut, f"{cut}: damaged, cut short or no checkpoint"),
        (foreign, f"{foreign}: no checkpoint of torchqm.learn.MatchModule"),
        (wide, f"{wide}: of another architecture: model.channels is 7 in it and 6 here"),
        ("https://x.org/a.ckpt", "https://x.org/a.ckpt: a URL"),
    ):
        for command in ("fit", "test"):
            assert error_of(capsys, command, "--config", given, "--ckpt_path", path).startswith(text)
    assert not (tmp_path / "run").exists()
    line = error_of(capsys, "fit", "--config", given, "--model.channels", "7", "--ckpt_path", wide)
    assert line.startswith(f"{wide}: weights without the state of a training")
    line = error_of(capsys, "test", "--config", given, "--ckpt_path", wide, "--weights_only", "false")
    assert line.startswith("weights_only: false given; nothing in a checkpoint is executed")


def test_options_of_a_checkpoint_do_not_take_the_place_of_those_given(tmp_path):
    module = MatchModule(**SMALL, w_bij=0.5)
    path = tmp_path / "old.ckpt"
    content = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams)} | VERSION
    torch.save(content, path)
    found = evaluate(["--config", str(config(tmp_path)), "--ckpt_path", str(path), "--model.w_bij", "2"])
    assert found.model.hparams["w_bij"] == 2
    first = next(iter(module.state_dict()))
    assert torch.equal(found.model.state_dict()[first], module.state_dict()[first])


def test_a_run_that_cannot_go_on_names_the_pairs_keeps_the_batch_and_the_checkpoints(tmp_path, capsys, monkeypatch):
    def spoiled(self):  # what a learning rate that is too high comes to, in the second epoch
        if self.current_epoch == 1:
            with torch.no_grad():
                next(self.parameters()).fill_(float("nan"))

    monkeypatch.setattr(MatchModule, "on_train_epoch_start", spoiled)
    line = error_of(capsys, "fit", "--config", str(config(tmp_path)))
    file = tmp_path / "run" / "stopped-step-1.pt"
    assert "at the pairs ellipsoid-0-pose" in line
    assert line.endswith(f"in step 1 of epoch 1; batch and weights are kept in {file}")
    kept = torch.load(file, weights_only=True)
    assert sorted(kept["pairs"]) == [f"ellipsoid-0-pose{a} -> ellipsoid-0-pose{1 - a}" for a in (0, 1)]
    assert kept["batch"]["first"]["evecs"].shape[0] == 2
    again = MatchModule(**kept["hparams"])
    again.load_state_dict(kept["state_dict"])
    with pytest.raises(ValueError, match=kept["reason"].split(":")[0]):
        again.net.losses(kept["batch"])
    last = MatchModule.load_from_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    assert all(p.isfinite().all() for p in last.parameters())
    assert (tmp_path / "run" / "curves.png").is_file()


def test_an_interrupt_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(MatchModule, "on_train_epoch_start", interrupted)
    import signal

    before = signal.getsignal(signal.SIGINT)
    try:
        assert main(["fit", "--config", str(config(tmp_path))]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    run = tmp_path / "run"
    assert f"the run folder {run} is kept, 'torchqm fit --resume {run}' goes on" in capsys.readouterr().err


def test_what_cannot_work_is_found_before_a_folder_is_made(tmp_path, capsys):
    given = str(config(tmp_path, model__tau=-1.0))
    assert error_of(capsys, "fit", "--config", given).startswith(f"{given}: model.tau: -1.0 given, expected a pos")
    given = str(config(tmp_path))
    for words, message in (
        (("--trainer.max_epoch", "3"), "--trainer.max_epoch: no such option; the nearest is --trainer.max_epochs"),
        (("--model.inputs", "[wkss]"), "--model.inputs: 'wkss' given, allowed are xyz"),
        (("--data.truth", "maybe"), "--data.truth: 'maybe' given, allowed are required"),
        (("--data.split", "draw", "--data.shares", "[0,0,1]"), "--data.shares: [0.0, 0.0, 1.0] given, of train"),
        (("--data.truth=none", "--model.supervision", "orbit"),
         "--data.truth: 'none' given, but model.supervision 'orbit' needs a truth"),
        (("--checkpoint.monitor", "val_orbit_eror"), "--checkpoint.monitor: 'val_orbit_eror' given, but such a run"),
        (("--data.truth", "none"), "checkpoint.monitor: 'val_orbit_error' given, but such a run logs only"),
    ):  # fmt: skip
        assert error_of(capsys, "fit", "--config", given, *words).startswith(message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("workers", ["0", "1"])
def test_a_pair_without_truth_is_one_line_with_the_options_that_help(tmp_path, capsys, monkeypatch, workers):
    """Meshes with triangles of their own; found at the first pair, and where that has a truth, when it is loaded."""
    (tmp_path / "m").mkdir()
    save_mesh(creature(), tmp_path / "m" / "a.off")
    save_mesh(creature(600), tmp_path / "m" / "b.off")
    words = [*("fit", "--config", str(config(tmp_path)), "--data.root", str(tmp_path / "m"), "--data.split", "draw")]
    words += ["--data.pairs", "all", "--data.shares", "[1,0,0]", "--data.workers", workers]
    line = error_of(capsys, *words)
    assert line.startswith(f"{tmp_path / 'm'}: no truth from a to b: ")
    assert line.endswith("--data.truth optional takes pairs without a truth, too, --data.truth none reads none at all")
    assert not (tmp_path / "run").exists()
    monkeypatch.setattr("torchqm.cli.lightning.first_truths", lambda *_: None)
    late = error_of(capsys, *words)
    assert late.startswith(f"{tmp_path / 'm'}: no truth from ")
    assert late.endswith("--data.truth none reads none at all")


def test_resuming_a_test_or_into_another_folder_is_refused(tmp_path, capsys):
    assert main(["fit", "--config", str(config(tmp_path)), "--trainer.max_epochs", "1", "--pictures.every", "0"]) == 0
    run = tmp_path / "run"
    assert main(["test", str(run)]) == 0
    capsys.readouterr()
    tested = run / "test" / "version_0"
    wanted = f"{tested}: the folder of a test, not of a training; the run that was tested is {run}"
    assert error_of(capsys, "fit", "--resume", str(tested)) == wanted
    assert error_of(capsys, "test", str(tested)) == wanted
    for option in ("--trainer.logger.init_args.version", "--trainer.logger.init_args.save_dir"):
        line = error_of(capsys, "fit", "--resume", str(run), f"{option}=other")
        assert line.startswith(f"--resume, {option}: give one of them; a run goes on in its own folder, {run}")
