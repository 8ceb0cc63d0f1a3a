import pytest
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchqm.cli.config_faults import refused, stops, value_faults
from torchqm.cli.console import UserError
from torchqm.cli.learn import fit, learn
from torchqm.data.base import TruthError
from torchqm.learn import NetOptions
from torchqm.learn.faults import StepError

EARLY = "pytorch_lightning.callbacks.EarlyStopping"


def line_of(tmp_path, text, *words):
    """What a training says whose configuration has this, and the file."""
    file = tmp_path / "c.yaml"
    file.write_text("data: {root: 'synthetic:'}\n" + text)
    with pytest.raises(UserError) as caught:
        learn(["--config", str(file), "--trainer.accelerator", "cpu", *words], run=False)
    return str(caught.value).replace(str(file), "FILE")


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        ("checkpoint: {mode: low}", [], "FILE: checkpoint.mode: 'low' given; `mode` can be min, max but got low"),
        ("trainer: {devices: '{}'}", [], "FILE: trainer.devices: '{}' given; `devices` selected with `CPUAccelerator` "
         "should be an int > 0."),
        ("trainer: {devices: 1}", ["--trainer.devices={}"], "--trainer.devices: {} given; `devices` selected with"),
        ("seed_everything: -1", [], "FILE: seed_everything: -1 given; -1 is not in bounds, numpy accepts from 0 to"),
        (f"trainer: {{callbacks: [{{class_path: {EARLY}, init_args: {{monitor: val_loss, mode: low}}}}]}}", [],
         "FILE: trainer.callbacks.init_args.mode: 'low' given; `mode` can be min, max, got low"),
        ("", ["--trainer.plugins", "foo"], "--trainer.plugins: 'foo' given, expected the dotted name of a class"),
    ],
)  # fmt: skip
def test_what_lightning_refuses_is_one_line_with_file_option_and_value(tmp_path, text, words, line):
    assert line_of(tmp_path, text, *words).startswith(line)


def test_what_the_training_refuses_of_its_options_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = "synthetic:kinds=ellipsoid;poses=3;verts=500;triangulation=shared"
    words = ["--data.root", root, "--data.shares", "[0.7,0.3,0]", "--model.k=8", "--model.setup=quotient"]
    words += ["--trainer.accelerator=cpu", "--trainer.max_epochs=1"]
    with pytest.raises(UserError, match=r"^--trainer\.val_check_interval: 50 given; `val_check_interval` \(50\) must "):
        fit([*words, "--trainer.logger=false", "--trainer.val_check_interval", "50"])


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        # The name decides, then the value that the text has, then which name is first.
        ("`strategy` x needs `accelerator='cuda'`", ["--trainer.accelerator=cpu", "--trainer.strategy=x"],
         "--trainer.strategy: 'x' given; "),
        ("`mode` can be a, b, got low", ["--checkpoint.mode=high", "--trainer.callbacks=[{init_args: {mode: low}}]"],
         "--trainer.callbacks.init_args.mode: 'low' given; "),
        ("no gpu", ["--trainer.devices=1", "--trainer.accelerator=gpu"], "--trainer.accelerator: 'gpu' given; "),
        ("at least 1", ["--trainer.devices=1"], "trainer: at least 1"),  # a number alone says nothing
        ("gpu", ["--trainer.strategy=gpu", "--trainer.accelerator=gpu"], "trainer: gpu"),  # which of them?
        ("`width` is odd", ["--model.width=3"], "trainer: `width` is odd"),  # the model speaks for itself
    ],
)  # fmt: skip
def test_which_option_a_text_is_about(text, words, line):
    assert refused(MisconfigurationException(text), [], words, "trainer").startswith(line)


def test_an_object_that_could_not_be_made_is_named(tmp_path):
    text = (
        "Does not validate against any of the Union subtypes\nSubtypes: [x]\nErrors:\n  - Not a valid subclass of "
        "Logger\n    Subclass types expect one of:\n    - a class path (str)\n  - Problem with given class_path "
        "'a.Wandb':\n      wandb is not installed\n  - Expected a <class 'bool'>\nGiven value type: <class 'list'>\n"
        "Given value: []"
    )
    words = ["--trainer.logger", "[{class_path: a.Csv}, {class_path: a.Wandb}]"]
    assert refused(ValueError(text), [], words) == "--trainer.logger: 'a.Wandb' given; wandb is not installed"
    assert refused(KeyError("x"), [], [], "trainer") == "trainer: KeyError: 'x'"


def test_faults_of_torchqm_speak_for_themselves_and_its_bugs_keep_their_traceback():
    def keys():
        return ["model.k"]

    with pytest.raises(UserError, match=r"^--model\.k: 0 given"), value_faults(["--model.k=0"], keys, "trainer"):
        NetOptions(k=0)
    broken = type("Broken", (NetOptions,), {"k": property(lambda self: {}["x"], lambda self, value: None)})
    with pytest.raises(KeyError), value_faults([], keys, "trainer"):
        broken()
    with pytest.raises(UserError, match=r"^trainer: KeyError: 'x'$"), value_faults([], keys, "trainer"):
        {}["x"]  # not called by torchqm
    with pytest.raises(UserError, match=r"^said$"), value_faults([], keys, "trainer"):
        raise UserError("said")


def test_a_run_that_stops():
    for error, line in (
        (StepError("the loss is nan"), "^the loss is nan$"),
        (TruthError("no truth"), "^no truth; --data.truth optional"),
        (MisconfigurationException("no `devices`"), "^no `devices`$"),
    ):
        with pytest.raises(UserError, match=line), stops([]):
            raise error
    with pytest.raises(ValueError, match="devices"), stops(["--trainer.devices", "3"]):
        raise ValueError("devices")  # not from Lightning: a bug
