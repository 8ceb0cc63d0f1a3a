"""The LightningCLI: its callbacks, its checkpoints, and more than one process."""

import csv
import os
import subprocess
import sys

import pytest
import yaml

from torchqm.cli.console import UserError
from torchqm.cli.learn import fit, learn
from torchqm.cli.lightning import own_callbacks

pytestmark = pytest.mark.usefixtures("plain_curves")

ROOT = "synthetic:kinds=ellipsoid;poses=4;verts=500;triangulation=shared"


def arguments(folder, name, *more):
    """Four pairs to train on, in two epochs, and two to validate on; everything in double precision."""
    names = [f"ellipsoid-0-pose{pose}" for pose in range(4)]
    split = folder / "split.yaml"
    split.write_text(yaml.safe_dump({"train": names[:2], "validation": names[2:]}))
    options = {
        "data": {"root": ROOT, "split": str(split), "pairs": "within-class+self", "dtype": "float64"},
        "model": {"k": 20, "channels": 6, "width": 8, "signature": 8, "setup": "quotient+odd", "odd_pairs": 8},
        "trainer": {"max_epochs": 2, "accelerator": "cpu", "precision": "64-true", "num_sanity_val_steps": 0,
                    "enable_progress_bar": False, "log_every_n_steps": 1},
        "trainer.logger": {"init_args.save_dir": str(folder), "init_args.version": name},
        "pictures": {"every": 0},
    }  # fmt: skip
    given = [word for group, values in options.items() for key, value in values.items()
             for word in (f"--{group}.{key}", str(value))]  # fmt: skip
    return [*given, *more]


def logged(folder):
    with (folder / "metrics.csv").open() as file:
        rows = [{key: float(cell) for key, cell in row.items() if cell} for row in csv.DictReader(file)]
    return [{key: v for row in rows if row["epoch"] == epoch for key, v in row.items()} for epoch in (0, 1)]


def names_of(*words):
    trainer = learn(["--data.root", "synthetic:", *words], run=False).trainer
    return [type(callback).__name__ for callback in trainer.callbacks]


def test_callbacks_of_a_config_are_added_to_those_of_every_run(tmp_path):
    own = {type(callback).__name__ for callback in own_callbacks()}
    assert own == {"LastEpoch", "Versions", "Curves"}
    path = tmp_path / "config.yaml"
    for given in ("pytorch_lightning.callbacks.LearningRateMonitor",
                  [{"class_path": "pytorch_lightning.callbacks.LearningRateMonitor"}]):  # fmt: skip
        path.write_text(yaml.safe_dump({"trainer": {"callbacks": given}}))
        names = names_of("--config", str(path))
        assert {"LearningRateMonitor", "BestCheckpoint", "PairPictures", "RunConfig"} | own <= set(names)
        # What is kept of an epoch has in it what all the others made of it.
        assert names[-1] == "LastEpoch"
    path.write_text(yaml.safe_dump({"trainer": {"callbacks": None}}))
    assert {"BestCheckpoint", "PairPictures", "RunConfig"} | own <= set(names_of("--config", str(path)))
    twice = {"class_path": "torchqm.learn.callbacks.LastEpoch"}
    assert names_of("--trainer.callbacks", str([twice]))[-1] == "LastEpoch"
    same = {"class_path": "torchqm.learn.callbacks.BestCheckpoint", "init_args": {"monitor": "val_orbit_error"}}
    with pytest.raises(UserError, match=r"trainer\.callbacks: BestCheckpoint is there twice with the same options"):
        names_of("--trainer.callbacks", str([same]))


def both(tmp_path, *more):
    """Metrics of one process with two pairs in a batch, and of two with one."""
    words = [*more, "--data.batch_size", "1", "--trainer.devices", "2", "--trainer.strategy", "ddp"]
    words = arguments(tmp_path, "two", *words)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1"}
    command = [sys.executable, "-m", "torchqm", "fit", *words]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    fit(arguments(tmp_path, "one", *more, "--data.batch_size", "2", "--trainer.devices", "1"))
    text, _ = running.communicate(timeout=600)
    assert running.returncode == 0, text
    assert "distributed_backend=gloo" in text
    assert "MEMBER: 2/2" in text
    return logged(tmp_path / "one"), logged(tmp_path / "two")


def test_two_processes_train_as_one_with_twice_the_batch(tmp_path):
    """Also where one of them has no truth in its batch.

    Two bodies: two of six training pairs have a truth, and one of the three to validate on, where one has more.
    """
    names = [[f"ellipsoid-{body}-pose{pose}" for pose in range(4)] for body in (0, 1)]
    root = "synthetic:kinds=ellipsoid;bodies=2;poses=4;verts=500;triangulation=shared"
    split = tmp_path / "mixed.yaml"
    parts = {"train": [*names[0][:2], *names[1][:2]], "validation": [names[0][2], *names[1][2:]]}
    split.write_text(yaml.safe_dump(parts))
    one, two = both(
        tmp_path,
        *("--data.root", root, "--data.split", str(split), "--data.pairs", "unordered", "--data.truth", "optional"),
        *("--model.supervision", "orbit"),
    )
    names = {"train_loss", "train_l_align", "train_l_truth", "val_l_truth", "val_loss", "val_orbit_error"}
    assert set(one[0]) == set(two[0]) >= names
    assert one[1]["train_loss"] < one[0]["train_loss"]
    assert {path.name for path in (tmp_path / "two").iterdir()} >= {"config.yaml", "versions.json", "curves.png"}
    for first, second in zip(one, two, strict=True):
        assert second == pytest.approx(first, rel=1e-9, abs=1e-12)
