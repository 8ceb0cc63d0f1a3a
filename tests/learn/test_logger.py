import csv
import sys

import pytest
import torch

from torchqm.learn.logger import RunLogger


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_table_and_events_have_the_same_numbers_in_one_folder(tmp_path):
    logger = RunLogger(str(tmp_path))
    logger.log_metrics({"train_loss": torch.tensor(2.5), "epoch": 0}, step=1)
    logger.log_metrics({"val_loss": 1.5}, step=2)
    assert len(rows(tmp_path / "version_0" / "metrics.csv")) == 2  # at once, not only in the end
    logger.finalize("success")
    assert RunLogger(str(tmp_path)).version == 1

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "version_0"))
    events.Reload()
    read = {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert read == {"train_loss": [(1, 2.5)], "epoch": [(1, 0.0)], "val_loss": [(2, 1.5)]}
    table = rows(tmp_path / "version_0" / "metrics.csv")
    assert [(row["step"], row["train_loss"], row["val_loss"]) for row in table] == [("1", "2.5", ""), ("2", "", "1.5")]


def test_an_earlier_table_is_kept(tmp_path):
    for number in range(3):
        logger = RunLogger(str(tmp_path), version="run", events=False)
        logger.log_metrics({"a": float(number)}, step=0)
        logger.finalize("success")
    kept = {path.name: rows(path)[0]["a"] for path in (tmp_path / "run").iterdir() if path.suffix == ".csv"}
    assert kept == {"metrics-1.csv": "0.0", "metrics-2.csv": "1.0", "metrics.csv": "2.0"}
    assert not list((tmp_path / "run").glob("events*"))


def test_tensorboard_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ImportError, match=r"need tensorboard \(pip install 'torchqm\[learn\]', or give events=False\)"):
        RunLogger(str(tmp_path))
    RunLogger(str(tmp_path), events=False)
