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


def test_a_run_that_goes_on_keeps_the_rows_before_its_step_and_no_other(tmp_path):
    logger = RunLogger(str(tmp_path), "some", 3)
    for step in range(4):
        logger.log_metrics({"a": step / 3}, step=step)
    logger.finalize("success")
    path = tmp_path / "some" / "version_3" / "metrics.csv"
    whole = path.read_bytes()
    with path.open("a") as file:
        file.write("0.5")  # half a row: the process was killed
    on = RunLogger(str(tmp_path), flush_logs_every_n_steps=1).moved(path.parent.parent, path.parent.name, 2)
    assert on.log_dir == str(path.parent)
    for step in (2, 3):
        on.log_metrics({"a": step / 3}, step=step)
    on.finalize("success")
    assert path.read_bytes() == whole
    assert not path.with_name("metrics-1.csv").exists()

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(path.parent))
    events.Reload()
    assert [event.step for event in events.Scalars("a")] == [0, 1, 2, 3]  # not those twice that were logged twice
    assert RunLogger(str(tmp_path), events=False).moved(tmp_path / "new", None).log_dir == str(
        tmp_path / "new" / "version_0"
    )


def test_a_new_column_is_added_without_a_moment_in_which_rows_are_missing(tmp_path, monkeypatch):
    logger = RunLogger(str(tmp_path), version="run", events=False)
    logger.log_metrics({"a": 1.0}, step=0)
    path = tmp_path / "run" / "metrics.csv"
    before = path.read_bytes()

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(csv.DictWriter, "writerows", killed)
        with pytest.raises(KeyboardInterrupt):
            logger.log_metrics({"b": 2.0}, step=1)
    assert path.read_bytes() == before
    logger = RunLogger(str(tmp_path), version="other", events=False)
    for number, name in enumerate("ab"):
        logger.log_metrics({name: 1.0}, step=number)
    table = rows(tmp_path / "other" / "metrics.csv")
    assert table == [{"a": "1.0", "b": "", "step": "0"}, {"a": "", "b": "1.0", "step": "1"}]


def test_tensorboard_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ImportError, match=r"need tensorboard \(pip install 'torchqm\[learn\]', or give events=False\)"):
        RunLogger(str(tmp_path))
    RunLogger(str(tmp_path), events=False)
