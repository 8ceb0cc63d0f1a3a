import pytest

from torchqm.cli.agreement import check_monitor, check_truth, monitors, without_truth
from torchqm.cli.learn import fit
from torchqm.data.base import TruthError, TruthFileError
from torchqm.learn import MatchModule

pytestmark = pytest.mark.usefixtures("plain_curves")

ROOT = "synthetic:kinds=ellipsoid;poses=4;verts=500;triangulation=shared"
OPTIONS = dict(MatchModule(k=8).hparams)


@pytest.mark.parametrize(("supervision", "truth"), [("orbit", "required"), ("none", "none")])
def test_monitors_are_what_a_run_logs(tmp_path, supervision, truth):
    words = ["--data.root", ROOT, "--data.shares", "[0.5,0.5,0]", "--data.truth", truth, "--model.k", "20"]
    words += ["--model.supervision", supervision, "--model.setup", "quotient", "--model.w_lap", "0"]
    words += ["--checkpoint.monitor", "val_loss", "--trainer.max_epochs", "1", "--trainer.num_sanity_val_steps", "0"]
    done = fit([*words, "--trainer.logger.init_args.save_dir", str(tmp_path), "--pictures.every", "0"])
    assert set(done.trainer.callback_metrics) == set(monitors(done.model.hparams, truth != "none"))


def test_a_monitor_that_nothing_logs_is_named_with_the_nearest():
    for name in (None, "epoch", "step", "val_l_align"):
        check_monitor(name, OPTIONS)
    with pytest.raises(ValueError, match=r"monitor: 'val_los' given, .*; the nearest is val_loss"):
        check_monitor("val_los", OPTIONS)
    with pytest.raises(ValueError, match="monitor: 'val_l_truth' given"):
        check_monitor("val_l_truth", OPTIONS)


def test_a_supervision_needs_a_truth():
    for pair in (("none", "none"), ("optional", "orbit"), ("required", "plain")):
        check_truth(*pair)
    with pytest.raises(ValueError, match=r"^data\.truth: 'none' given, but model\.supervision 'plain' needs a truth"):
        check_truth("none", "plain")


def test_a_damaged_truth_is_not_said_to_be_optional():
    assert without_truth(TruthFileError("a.vts: line 3")) == "a.vts: line 3"
    worker = (
        "Caught TruthError in DataLoader worker process 0.\nOriginal Traceback:\n  x\nb.TruthError: m: none: here\n"
    )
    assert without_truth(TruthError(worker)).startswith("m: none: here; --data.truth optional takes")
