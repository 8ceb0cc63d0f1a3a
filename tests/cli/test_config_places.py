import pytest
import yaml

from torchqm.cli.config_places import given_options, place_of, sources_of


def test_what_belongs_to_an_object_is_where_the_object_is(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text(yaml.safe_dump({"trainer": {"callbacks": [{"class_path": "a.B"}]}, "model": {"k": 3}}))
    args = ["--config", str(file)]
    key = "trainer.callbacks.init_args.mode"
    assert place_of(key, sources_of(args)) == f"{file}: {key}"
    assert place_of(key, sources_of(["--trainer.callbacks=[\n]"])) == f"--{key}"
    assert place_of("model.lr", sources_of(args)) == "model.lr"  # a default: the file has another key of the group


def test_the_last_value_of_an_option_is_the_given_one(tmp_path):
    (tmp_path / "trainer.yaml").write_text("{devices: 2, callbacks: [{class_path: a.B, init_args: {mode: low}}]}")
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text("{trainer: trainer.yaml, seed_everything: 3}")
    second.write_text("{checkpoint: {mode: max}, seed_everything: 4}")
    args = ["fit", "--config", str(first), f"--config={second}", "--checkpoint.mode", "low", "--trainer.plugins=[1"]
    found = dict(given_options(sources_of(args)))
    assert found["seed_everything"] == 4
    assert found["checkpoint.mode"] == "low"
    assert found["trainer.devices"] == 2
    assert found["trainer.callbacks.init_args.mode"] == "low"
    assert found["trainer.plugins"] == "[1"  # no YAML, as it was written
    both = given_options(sources_of(["--trainer.callbacks", "[{class_path: a.B}, {class_path: a.C}]"]))
    assert both == [("trainer.callbacks.class_path", "a.B"), ("trainer.callbacks.class_path", "a.C")]


def test_a_config_that_comes_after_an_option_wins_over_it(tmp_path):
    (tmp_path / "c.yaml").write_text("{trainer: t.yaml, model: {k: 3}}")
    (tmp_path / "t.yaml").write_text("{devices: 2}")
    file, option = ["--config", str(tmp_path / "c.yaml")], ["--trainer.devices=1"]
    for args, value, place in (
        ([*option, *file], 2, f"{tmp_path / 't.yaml'}: trainer.devices"),
        ([*file, *option], 1, "--trainer.devices"),
        ([*option, "--trainer", str(tmp_path / "t.yaml")], 2, f"{tmp_path / 't.yaml'}: trainer.devices"),
        ([*file, *option, "--config={trainer: {devices: 3}}"], 3, "--config: trainer.devices"),
        ([*option, "--trainer", "{devices: 4}"], 4, "--trainer.devices"),
    ):
        sources = sources_of(args)
        assert place_of("trainer.devices", sources) == place
        assert dict(given_options(sources))["trainer.devices"] == value


def test_a_config_as_text_is_a_source_however_long_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.yaml").write_text("{devices: 2}")
    text = f"{{trainer: t.yaml, data: {{root: {'x' * 5000}}}}}"  # longer than a path can be
    for args in (["--config", text], [f"--config={text}"], ["-c", text]):
        sources = sources_of(args)
        assert [source.place for source in sources] == [args[0].split("=")[0], "t.yaml"]
        assert place_of("data.root", sources) == f"{args[0].split('=')[0]}: data.root"
        assert dict(given_options(sources))["trainer.devices"] == 2
    assert sources_of(["--trainer", f"{'x' * 5000}.yaml"])[0].place == ""


def test_the_class_of_an_object_comes_before_its_arguments():
    found = given_options(sources_of(["--trainer.logger", "{init_args: {name: n}, class_path: a.B}"]))
    assert found == [("trainer.logger.class_path", "a.B"), ("trainer.logger.init_args.name", "n")]


@pytest.mark.parametrize("args", [["--config", "none.yaml"], ["--config", "{a: [1"], ["--model.lr", "3"], []])
def test_files_that_are_not_there_and_texts_that_are_no_config_are_none(args):
    assert not [source for source in sources_of(args) if source.place or source.fault]


@pytest.mark.parametrize("text", ["[a, b]", "", "word"])
def test_files_without_keys_have_no_options(tmp_path, text):
    (tmp_path / "c.yaml").write_text(text)
    sources = sources_of(["--config", str(tmp_path / "c.yaml")])
    assert given_options(sources) == []
    assert place_of("model.lr", sources) == "model.lr"


def test_a_file_that_names_itself_has_an_end(tmp_path):
    (tmp_path / "a.yaml").write_text("trainer: b.yaml")
    (tmp_path / "b.yaml").write_text("x: a.yaml")
    assert len(sources_of(["--config", str(tmp_path / "a.yaml")])) == 2
