import pytest

from torchqm.cli.config_errors import explained, nearest_key, placed

KEYS = ["model.lr", "model.k", "model.weight_decay", "data.root", "data.batch_size", "trainer.max_epochs"]


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("model.lrr", "model.lr"),
        ("modle.k", "model.k"),
        ("data.batchsize", "data.batch_size"),
        ("root", "data.root"),
        ("max_epoch", "trainer.max_epochs"),
        ("zzz", None),
    ],
)
def test_the_nearest_key(wrong, right):
    assert nearest_key(wrong, KEYS) == right


def test_the_file_that_has_the_key_is_named_also_where_another_names_it(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "m.yaml").write_text("k: 3\nlrr: 1\n")
    main = tmp_path / "main.yaml"
    main.write_text("model: model/m.yaml\ndata: {root: x}\n")
    message = "Subcommand 'fit' does not accept option 'model.lrr'"
    inner = tmp_path / "model" / "m.yaml"
    wanted = f"{inner}: model.lrr: no such key; the nearest is model.lr"
    assert explained(message, KEYS, ["fit", "--config", str(main)]) == wanted
    assert explained(message, KEYS, ["fit", f"--config={main}"]) == wanted
    assert explained(message, KEYS, ["fit", "--model", str(inner)]) == wanted
    main.write_text("model: {lrr: 1}\n")
    assert explained(message, KEYS, ["--config", str(main)]).startswith(f"{main}: model.lrr: no such key")


def test_the_command_line_comes_before_the_file(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("model: {lr: 1}\n")
    message = "Parser key \"model.lr\":\n  Expected a <class 'float'>. Got value: fast"
    args = ["fit", "--config", str(file)]
    assert explained(message, KEYS, args) == f"{file}: model.lr: 'fast' given, expected float"
    assert explained(message, KEYS, [*args, "--model.lr=fast"]) == "--model.lr: 'fast' given, expected float"


def test_a_file_that_is_no_yaml_is_named(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("model: [1\n")
    text = explained("Problems parsing config: ...", KEYS, ["--config", str(file)])
    assert text.startswith(f"{file}: not readable as YAML (")
    assert "\n" not in text


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("unrecognized arguments: --model.lrr=3 x", "--model.lrr: no such option; the nearest is --model.lr"),
        ("unrecognized arguments: stray", "stray: not expected here; options begin with '--'"),
        ("unrecognized arguments: --qqqqq 1", "--qqqqq: no such option; none is near; see --help"),
        ("the following arguments are required: fit.data.root", "--data.root: not given, but needed"),
        ("argument --model.lr: expected one argument", "--model.lr: expected one argument"),
        ("something\n  else", "something else"),
    ],
)
def test_other_messages(message, line):
    assert explained(message, KEYS, []) == line


def test_a_fault_of_a_class_has_the_group_of_its_option_and_the_file(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("model: {k: 0}\n")
    assert placed("k: 0 given", [*KEYS, "data.k"], ["--config", str(file)]) == f"{file}: model.k: 0 given"
    assert placed("data.root: none", KEYS, ["--data.root=x"]) == "--data.root: none"
    for text in ("start: builtin", "no such thing: k", "/data/k: empty"):
        assert placed(text, KEYS, []) == text
