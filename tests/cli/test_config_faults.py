import sys

import pytest
import torch
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchqm.cli import lightning
from torchqm.cli.config_faults import refused, stops, value_faults
from torchqm.cli.console import UserError
from torchqm.cli.learn import fit, learn
from torchqm.data.base import TruthError
from torchqm.learn import MatchModule, NetOptions
from torchqm.learn.faults import StepError

EARLY = "pytorch_lightning.callbacks.EarlyStopping"
LOOPS, CORE = "pytorch_lightning.loops.fit_loop", "pytorch_lightning.core.module"
COMMAND, CLI, TRAINER = "torchqm.cli.lightning", "pytorch_lightning.cli", "pytorch_lightning.trainer.trainer"
OWN_CODE = """
from pytorch_lightning import Callback
from pytorch_lightning.loggers import CSVLogger
from pytorch_lightning.utilities.exceptions import MisconfigurationException

class Broken(Callback):
    def __init__(self, name: str = "auto"):
        self.table = {}["precision"]

class NoFile(Callback):
    def __init__(self, name: str = "auto"):
        raise RuntimeError("could not open `devices` file")

class Log(CSVLogger):
    def __init__(self, name: str = "auto"):
        self.table = {}["precision"]

class Told(Callback):
    def __init__(self, name: str = "auto", devices: int = 1):
        raise MisconfigurationException("`precision`, `devices`")
"""


@pytest.fixture
def own_code(tmp_path, monkeypatch):
    """A module of a user, ``own_code``, with callbacks and a logger."""
    (tmp_path / "own_code.py").write_text(OWN_CODE)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "own_code.py"
    sys.modules.pop("own_code", None)


def through(modules, error):
    """Raise an error in the last of some modules, of which each called the next."""
    space = {"__name__": modules[-1], "error": error}
    exec("def here(): raise error", space)
    for name in modules[-2::-1]:
        space = {"__name__": name, "below": space["here"]}
        exec("def here(): below()", space)
    space["here"]()


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


@pytest.mark.parametrize(
    ("modules", "text"),
    [
        ([COMMAND, CLI, LOOPS], "no devices file"),  # a word, not a name
        ([COMMAND, CLI, LOOPS], "the profiler is simple"),
        ([COMMAND, CLI, LOOPS, "torchqm.learn.module", CORE], "`devices`"),
        ([COMMAND, CLI, LOOPS, "own_code", CORE], "`devices`"),
        ([COMMAND, CLI, LOOPS, "own_code"], "`devices`"),
    ],
)
def test_errors_of_a_training_keep_their_traceback_unless_lightning_quotes_an_option(modules, text):
    words = ["--trainer.devices", "1", "--trainer.profiler=simple", "--trainer.callbacks.init_args.monitor=val_lss"]
    with pytest.raises(ValueError, match=f"^{text}$"), stops(words):
        through(modules, ValueError(text))
    for said, line in (
        ("`Trainer(devices=1)` is not", "^--trainer.devices: 1 given; "),
        ("no metric `val_lss`", "^--trainer.callbacks.init_args.monitor: 'val_lss' given; no metric"),
    ):
        with pytest.raises(UserError, match=line), stops(words):
            through([COMMAND, CLI, LOOPS, "torch.utils._contextlib", TRAINER], ValueError(said))


def test_what_the_module_logs_is_no_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    step = MatchModule.training_step

    def logs(self, *args, **named):
        self.log("train/devices", torch.ones(2))  # Lightning refuses two numbers
        return step(self, *args, **named)

    monkeypatch.setattr(MatchModule, "training_step", logs)
    root = "synthetic:kinds=ellipsoid;poses=3;verts=500;triangulation=shared"
    words = ["--data.root", root, "--data.shares", "[0.7,0.3,0]", "--model.k=8", "--model.setup=quotient"]
    words += ["--trainer.accelerator=cpu", "--trainer.max_epochs=1", "--trainer.devices=1", "--trainer.logger=false"]
    with pytest.raises(ValueError, match=r"^`self\.log\(train/devices, .* must have a single element"):
        fit(words)


@pytest.mark.parametrize(
    ("modules", "error", "line"),
    [
        (["torchqm.cli.run_folder"], KeyError("asked"), None),
        ([COMMAND, CLI, COMMAND, "torchqm.cli.run_folder"], AttributeError("folder"), None),
        ([COMMAND, "json.decoder"], ValueError("`devices`"), None),  # not said on purpose
        (["torchqm.learn.module", "torch.nn"], RuntimeError("size"), None),
        ([COMMAND, CLI, TRAINER, "own_code.parts"], ValueError("`devices`"), None),
        ([COMMAND, CLI, TRAINER, "own_code.parts", "torch.nn"], ImportError("devices"), None),
        (["torchqm.cli.run_folder"], ValueError("asked"), "asked"),
        (["torchqm.cli.run_folder", "pathlib"], FileNotFoundError("asked"), "asked"),
        ([COMMAND, CLI, TRAINER], KeyError("x"), "trainer: KeyError: 'x'"),
        ([COMMAND, CLI, TRAINER], RuntimeError("CUDA error in the profiler"), "trainer: CUDA error in the profiler"),
        ([COMMAND, CLI, TRAINER], RuntimeError("`profiler`"), "--trainer.profiler: 'simple' given; `profiler`"),
    ],
)
def test_bugs_keep_their_traceback_wherever_they_are(modules, error, line):
    words = ["--trainer.devices=1", "--trainer.profiler=simple", "--trainer.callbacks=[{class_path: own_code.Two}]"]
    with pytest.raises(UserError if line else type(error)) as caught, value_faults(words, list, "trainer"):
        through(modules, error)
    if line:
        assert str(caught.value) == line
    else:
        assert caught.value is error


def test_a_bug_of_the_command_keeps_its_traceback_in_the_command_too(monkeypatch):
    monkeypatch.setattr(lightning, "check_truth", lambda *_: {}["asked"])
    with pytest.raises(KeyError, match="asked"):
        learn(["--data.root=synthetic:", "--trainer.accelerator=cpu"], run=False)


@pytest.mark.parametrize(
    ("option", "kind"),
    [
        ("--trainer.callbacks=[{class_path: own_code.Broken}]", KeyError),
        ("--trainer.callbacks+=own_code.NoFile", RuntimeError),
        ("--trainer.logger=[{class_path: own_code.Log}]", KeyError),  # of jsonargparse's reasons not the first
    ],
)
def test_an_error_of_a_users_class_keeps_its_traceback(own_code, option, kind):
    words = ["--data.root=synthetic:", "--trainer.accelerator=cpu", "--trainer.precision=32", "--trainer.devices=1"]
    with pytest.raises(kind, match=r"precision|could not open") as caught:
        learn([*words, option], run=False)
    assert caught.traceback[-1].path == own_code


@pytest.mark.parametrize(
    ("callbacks", "line"),
    [
        ("[{class_path: own_code.Told}]", "'own_code.Told' given; `precision`, `devices`"),
        ("[{class_path: own_code.Told, init_args: {devices: 2}}]", ".init_args.devices: 2 given; `precision`, `de"),
        (f"[{{class_path: {EARLY}, init_args: {{monitor: a, mode: min}}}}, {{class_path: {EARLY}, init_args: "
         "{monitor: b, mode: low}}, {class_path: own_code.Told, init_args: {name: mode}}]", ".init_args.mode: 'low' "),
        (f"[{{class_path: own_code.Broken, init_args: {{name: low}}}}, {{class_path: {EARLY}, init_args: {{mode: low, "
         "monitor: a}}]", None),
    ],
)  # fmt: skip
def test_what_an_object_refuses_is_an_argument_of_it_or_the_object(own_code, callbacks, line):
    words = ["--data.root=synthetic:", "--trainer.accelerator=cpu", "--trainer.precision=32", "--trainer.devices=1"]
    with pytest.raises(UserError if line else KeyError) as caught:
        learn([*words, "--checkpoint.mode=max", "--trainer.callbacks", callbacks], run=False)
    assert str(caught.value).startswith("--trainer.callbacks" if line else "'precision'")
    assert (line or "") in str(caught.value)
