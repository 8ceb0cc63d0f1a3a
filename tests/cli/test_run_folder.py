"""Runs that are stopped at any moment and gone on with, and tests of them: what is in the folder afterwards."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from filelock import FileLock
from pytorch_lightning.loggers import CSVLogger, TensorBoardLogger

from torchqm.cli.console import UserError
from torchqm.cli.learn import evaluate, fit
from torchqm.cli.run_folder import hold, place_of_test, place_of_training, read_config
from torchqm.learn.callbacks import LastEpoch
from torchqm.learn.logger import RunLogger

pytestmark = pytest.mark.usefixtures("plain_curves")

ROOT = "synthetic:kinds=ellipsoid;poses=6;verts=500;triangulation=shared"
EPOCHS = 4

CALLBACK = '''
"""A user's own callback: a row for each step, copies of the run folder, a stop in the midst of an epoch."""
import os, shutil, time
from pathlib import Path
from pytorch_lightning import Callback


class Watch(Callback):
    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        pl_module.log("train_step_loss", outputs["loss"].detach(), on_step=True, on_epoch=False, batch_size=1)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if batch_idx == 1:
            keep(trainer, f"batch-{trainer.current_epoch}")
            if trainer.current_epoch == 2 and (ready := os.environ.get("WATCH_READY")):
                Path(ready).touch()
                time.sleep(600)

    def on_train_epoch_end(self, trainer, pl_module):
        keep(trainer, f"end-{trainer.current_epoch}")


def keep(trainer, name):
    if folder := os.environ.get("WATCH_KEEP"):
        shutil.copytree(trainer.log_dir, Path(folder) / name)
'''


def config(folder):
    """A run of a second: two pairs to train on, each a step, and two to validate on. Its best epoch is the first."""
    names = [f"ellipsoid-0-pose{pose}" for pose in range(6)]
    split = folder / "split.yaml"
    split.write_text(yaml.safe_dump({"train": names[:2], "validation": names[2:4], "test": names[4:]}))
    trainer = {"max_epochs": EPOCHS, "accelerator": "cpu", "log_every_n_steps": 1, "num_sanity_val_steps": 0}
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "callbacks": [{"class_path": "watch.Watch"}]}
    logger = {"class_path": "torchqm.learn.logger.RunLogger", "init_args": {"save_dir": str(folder / "runs")}}
    values = {
        "model": {"k": 8, "channels": 6, "width": 8, "signature": 8, "setup": "quotient"},
        "data": {"root": ROOT, "split": str(split)},
        "trainer": trainer | quiet | {"logger": logger},
        "checkpoint": {"mode": "max"},
        "pictures": {"every": 0},
    }
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run that was not stopped, and copies of its folder at the moments at which a kill would have left it so."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "watch.py").write_text(CALLBACK)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("WATCH_KEEP", str(folder))
        own = LastEpoch.on_train_epoch_end

        def and_kept(self, trainer, pl_module):
            own(self, trainer, pl_module)
            shutil.copytree(trainer.log_dir, folder / f"unlogged-{trainer.current_epoch}")

        patch.setattr(LastEpoch, "on_train_epoch_end", and_kept)
        fit(["--config", str(config(folder))])
    return folder


@pytest.fixture
def watch(folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delenv("WATCH_KEEP", raising=False)
    return folder / "runs" / "version_0"


def state(run):
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)


def flat(value):
    """All that a checkpoint has, one below the other; of a path only the file's name."""
    if isinstance(value, dict):
        return [part for key, item in value.items() for part in [str(key).rpartition("/")[2], *flat(item)]]
    if isinstance(value, list | tuple):
        return [part for item in value for part in flat(item)]
    if isinstance(value, torch.Tensor):
        return [(value.dtype, value.tolist())]
    return [value.rpartition("/")[2] if isinstance(value, str) else value]


def best(run):
    (found,) = [value for key, value in state(run)["callbacks"].items() if key.startswith("BestCheckpoint")]
    assert [Path(path).parent.resolve() for path in found["best_k_models"]] == [(run / "checkpoints").resolve()]
    return found["best_model_score"].item(), Path(found["best_model_path"]).name


def assert_equal_runs(run, whole):
    """Weights, state of Adam and of the loops, metrics and best score, and the files."""
    first, second = state(run), state(whole)
    for key in ("state_dict", "optimizer_states", "loops", "epoch", "global_step", "hyper_parameters"):
        assert flat(first[key]) == flat(second[key]), key
    assert best(run) == best(whole)
    assert best(whole)[1] == "best-epoch=0.ckpt"
    for name in ("metrics.csv", "config.yaml", "versions.json"):
        assert (run / name).read_bytes() == (whole / name).read_bytes(), name
    kept = [{path.name for path in (folder / "checkpoints").iterdir()} for folder in (run, whole)]
    assert kept[0] == kept[1] == {"last.ckpt", "best-epoch=0.ckpt"}


def test_the_run_that_was_not_stopped_has_a_row_for_each_step_and_epoch(watch):
    steps = [line.split(",")[1] for line in (watch / "metrics.csv").read_text().splitlines()[1:]]
    assert [steps.count(str(step)) for step in range(2 * EPOCHS)] == [1, 3] * EPOCHS  # the second: validation and epoch


@pytest.mark.parametrize("moment", ["batch-2", "end-2", "unlogged-2"])
def test_what_a_kill_leaves_at_any_moment_is_gone_on_with_to_the_same_end(moment, folder, watch):
    run = folder / moment
    before = (run / "metrics.csv").read_text()
    assert len(before.splitlines()) > 1 + 2 * 4  # more than the two whole epochs: rows that are computed again
    with (run / "metrics.csv").open("a") as file:
        file.write("2,5,0.0")  # half a row
    fit(["--resume", str(run)])
    assert_equal_runs(run, watch)


def test_a_run_without_a_whole_epoch_begins_anew_in_its_folder_and_loses_nothing(folder, watch, capsys):
    run = folder / "batch-0"
    rows = (run / "metrics.csv").read_bytes()
    fit(["--resume", str(run)])
    assert_equal_runs(run, watch)
    assert (run / "metrics-1.csv").read_bytes() == rows
    assert f"{run}: no epoch was finished, so that it begins anew" in capsys.readouterr().err


def test_a_process_that_is_killed_in_the_midst_of_an_epoch(folder, watch, tmp_path, monkeypatch):
    ready = tmp_path / "ready"
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-m", "torchqm", "fit", "--config", str(folder / "config.yaml"),
               "--trainer.logger.init_args.save_dir", "here"]  # fmt: skip
    paths = os.pathsep.join([str(folder), str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"WATCH_READY": str(ready), "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    with (tmp_path / "said").open("w") as said:
        running = subprocess.Popen(command, stdout=said, stderr=said, env=environment)
        try:
            until = time.monotonic() + 120
            while not ready.exists() and running.poll() is None and time.monotonic() < until:
                time.sleep(0.02)
        finally:
            running.send_signal(signal.SIGKILL)
            running.wait()
    assert ready.exists(), (tmp_path / "said").read_text()
    assert running.returncode == -signal.SIGKILL
    run = Path("here", "version_0")
    assert state(run)["epoch"] == 1
    text = (run / "config.yaml").read_bytes()
    fit(["--config", str(run / "config.yaml"), "--ckpt_path", str(run / "checkpoints" / "last.ckpt")])
    assert [path.name for path in Path("here").iterdir()] == ["version_0"]
    assert (run / "config.yaml").read_bytes() == text
    (run / "config.yaml").write_bytes((watch / "config.yaml").read_bytes())  # differs in save_dir alone
    assert_equal_runs(run, watch)


def test_two_trainings_do_not_share_a_folder(folder, watch, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(folder / "runs" / "version_0", run)
    before = contents(run)
    with FileLock(run / ".lock"), pytest.raises(UserError, match="run: another training is writing there"):
        fit(["--resume", str(run), "--trainer.max_epochs", str(EPOCHS + 1)])
    assert contents(run) == before


def test_a_folder_is_held_by_one_alone_and_made_if_it_can_be(tmp_path):
    run = tmp_path / "runs" / "new"
    with hold(run), pytest.raises(UserError, match="new: another training is writing there"):
        hold(run)
    with hold(run):  # free again
        pass
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"file.run: the run folder cannot be made \(Not a directory\)"):
        hold(tmp_path / "file" / "run")


def contents(run):
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and "test" not in path.parts[-3:]}


def test_a_test_changes_nothing_in_the_run_and_writes_into_a_folder_of_its_own(folder, watch, tmp_path):
    run = tmp_path / "runs" / "version_0"
    shutil.copytree(watch, run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["trainer"]["logger"]["init_args"] |= {"save_dir": str(run.parent), "version": 0}  # given by the user
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    before = contents(run)
    evaluate([str(run), "--trainer.max_epochs", "9"])
    words = ["--config", str(run / "config.yaml"), "--ckpt_path", str(run / "checkpoints" / "last.ckpt")]
    evaluate([*words, "--trainer.logger.init_args.version", "0"])  # asked for, but there is a training
    evaluate([*words, "--trainer.logger.init_args.version", "mine"])
    assert contents(run) == before
    assert sorted(path.name for path in run.parent.iterdir()) == ["mine", "version_0"]
    places = [*(run / "test" / f"version_{number}" for number in range(2)), run.parent / "mine"]
    assert sorted((run / "test").iterdir()) == places[:2]
    for place in places:
        assert "test_orbit_error" in (place / "metrics.csv").read_text()
    assert [read_config(place)["ckpt_path"].rpartition("/")[2] for place in places[:2]] == [
        "best-epoch=0.ckpt",
        "last.ckpt",
    ]


def test_options_that_are_changed_hold_and_the_earlier_ones_are_kept(folder, watch, tmp_path, capsys):
    run = tmp_path / "version_0"
    shutil.copytree(watch, run)
    went = fit(["--resume", str(run), "--trainer.max_epochs=5", "--model.lr", "0.5"])
    assert went.trainer.optimizers[0].param_groups[0]["lr"] == 0.5
    assert went.trainer.log_dir == str(run)
    assert f"torchqm: {run}: goes on after 4 epochs, 8 steps\n" in capsys.readouterr().err
    assert (run / "config-1.yaml").read_bytes() == (watch / "config.yaml").read_bytes()
    assert read_config(run)["trainer"]["max_epochs"] == 5
    assert (run / "metrics.csv").read_text().startswith((watch / "metrics.csv").read_text())
    fit(["--resume", str(run)])
    assert f"{run}: goes on after 5 epochs, 10 steps; that is all it was to do" in capsys.readouterr().err


def test_another_config_or_an_earlier_state_begins_a_run_of_its_own(folder, watch, tmp_path, monkeypatch, capsys):
    shutil.copytree(watch, tmp_path / "runs" / "version_0")
    monkeypatch.chdir(tmp_path)
    run = Path("runs", "version_0")
    before = contents(run)
    words = ["--config", str(run / "config.yaml"), "--trainer.logger.init_args.save_dir", "runs"]
    last = ["--data.batch_size", "2", "--trainer.max_epochs", "5"]
    for file, more in (("last.ckpt", last), ("best-epoch=0.ckpt", ["--trainer.max_epochs", "2"])):
        went = fit([*words, "--ckpt_path", str(run / "checkpoints" / file), *more])
        new = Path(went.trainer.log_dir)
        assert f"{file}: a run of its own begins from this state" in capsys.readouterr().err
        assert [Path(path).parent for path in went.config_init["fit"]["checkpoint"].best_k_models] == [
            new / "checkpoints"
        ]
        assert read_config(new)["ckpt_path"] == str(run / "checkpoints" / file)
    assert sorted(path.name for path in run.parent.iterdir()) == ["version_0", "version_1", "version_2"]
    assert contents(run) == before


def test_places(tmp_path):
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    last, first = (run / "checkpoints" / name for name in ("last.ckpt", "best-epoch=0.ckpt"))
    for path in (last, first, run / "config.yaml"):
        path.touch()
    own, other = (RunLogger(str(tmp_path), version=name, events=False) for name in ("run", "other"))

    def train(path, logger, words=(), resumed=None, same=True):
        return place_of_training(path and str(path), logger, words, resumed, lambda folder: same)

    def folder_of(place):
        return None if place.folder is None else (place.folder, place.loggers[0].log_dir)

    assert folder_of(train(last, other)) == (run, str(run))
    assert folder_of(train(None, other, resumed=run)) == (run, str(run))
    assert folder_of(train(last, own, same=False)) == (run, str(run))  # its folder is asked for
    for place in (train(last, other, same=False), train(last, other, ["--trainer.logger.init_args.version=other"]),
                  train(first, other), train(None, own)):  # fmt: skip
        assert place.folder is None
        assert place.loggers in (own, other)
    with pytest.raises(UserError, match=r"best-epoch=0\.ckpt: not the last state of .*run, so that what came after it"):
        train(first, own)
    with pytest.raises(UserError, match=r"trainer\.logger: a run goes on in its folder \(.*run\) with RunLogger"):
        train(last, CSVLogger(str(tmp_path), None, "run"))
    events = TensorBoardLogger(str(tmp_path), "", "run")
    place = place_of_test(str(first), [events, own], [])
    assert [logger.log_dir for logger in place.loggers] == [str(run / "test" / "version_0")]
    assert place_of_test(str(first), [], []).loggers == []
    assert place_of_test(None, other, []).loggers is other


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--resume"], "--resume: the folder of a run is needed"),
        (["--resume", "--model.lr", "1"], "--resume: the folder of a run is needed"),
        (["--resume=none"], "none: no folder of a run; config.yaml is missing"),
        (["--resume", "a", "--ckpt_path=b"], "--resume, --ckpt_path: give one of them"),
    ],
)
def test_resume_needs_a_run(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        fit(words)
