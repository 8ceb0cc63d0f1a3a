"""benchmarks/learning_step.py measures what its text says."""

import importlib.util
import sys
from pathlib import Path

import pytest

from torchqm.cli.learn import learn
from torchqm.data.datamodule import PairDataModule
from torchqm.learn import MatchModule

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "learning_step.py"
SMALL = {"k": 8, "channels": 6, "width": 8, "signature": 8, "setup": "quotient"}


@pytest.fixture(scope="module")
def script():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPT.parent)
        spec = importlib.util.spec_from_file_location("learning_step", SCRIPT)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module
        sys.modules.pop("common", None)


def test_the_callbacks_of_a_run_are_in_and_the_first_and_the_last_step_are_out(script, tmp_path, monkeypatch):
    data = PairDataModule(
        "synthetic:kinds=ellipsoid;poses=2;verts=500;triangulation=shared",
        pairs="within-class+self",
        shares=(1, 0, 0),
        k=8,
    )
    data.setup("fit")
    assert len(data.train_dataloader()) == 4
    trainers, ticks = [], []
    own, tick = script.Trainer, script.Clock.tick
    monkeypatch.setattr(script, "Trainer", lambda **given: trainers.append(own(**given)) or trainers[0])
    monkeypatch.setattr(script.Clock, "tick", lambda clock: (tick(clock), ticks.append(list(clock.seconds))))
    found = script.under_lightning(MatchModule(**SMALL), data, tmp_path)
    assert len(ticks) == 4
    assert found == ticks[-1][1:]
    assert len(found) == 2
    assert len(script.bare(MatchModule(**SMALL).net, data, 1e-3)) == 2
    names = {type(callback).__name__ for callback in trainers[0].callbacks}
    fit = {type(callback).__name__ for callback in learn(["--data.root", "synthetic:"], run=False).trainer.callbacks}
    bars = {"RichProgressBar", "RichModelSummary", "TQDMProgressBar", "ModelSummary"}
    assert names == (fit - bars - {"RunConfig"}) | {"Clock"}
