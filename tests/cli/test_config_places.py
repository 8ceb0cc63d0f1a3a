import pytest
import yaml

from torchqm.cli.config_places import files_of, given_options, place_of


def test_what_belongs_to_an_object_is_where_the_object_is(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text(yaml.safe_dump({"trainer": {"callbacks": [{"class_path": "a.B"}]}, "model": {"k": 3}}))
    args = ["--config", str(file)]
    key = "trainer.callbacks.init_args.mode"
    assert place_of(key, args, files_of(args)) == f"{file}: {key}"
    assert place_of(key, ["--trainer.callbacks=[\n]"], []) == f"--{key}"
    assert place_of("model.lr", args, files_of(args)) == "model.lr"  # a default: the file has another key of the group


def test_the_last_value_of_an_option_is_the_given_one(tmp_path):
    (tmp_path / "trainer.yaml").write_text("{devices: 2, callbacks: [{class_path: a.B, init_args: {mode: low}}]}")
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text("{trainer: trainer.yaml, seed_everything: 3}")
    second.write_text("{checkpoint: {mode: max}, seed_everything: 4}")
    args = ["fit", "--config", str(first), f"--config={second}", "--checkpoint.mode", "low", "--trainer.plugins=[1"]
    found = dict(given_options(args, files_of(args)))
    assert found["seed_everything"] == 4
    assert found["checkpoint.mode"] == "low"
    assert found["trainer.devices"] == 2
    assert found["trainer.callbacks.init_args.mode"] == "low"
    assert found["trainer.plugins"] == "[1"  # no YAML, as it was written
    both = given_options(["--trainer.callbacks", "[{class_path: a.B}, {class_path: a.C}]"], [])
    assert both == [("trainer.callbacks.class_path", "a.B"), ("trainer.callbacks.class_path", "a.C")]


@pytest.mark.parametrize("args", [["--config", "none.yaml"], ["--model.lr", "3"], []])
def test_files_that_are_not_there_are_none(args):
    assert files_of(args) == []
