"""What the README says: its examples run, its commands, options, files and keys exist."""

import doctest
import re
import runpy
import sys
from pathlib import Path

import pytest

from torchqm.cli.main import build_parser

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_examples_run_in_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert blocks
    test = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, "README.md", "README.md", 0)
    report = []
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=report.append)
    assert result.failed == 0, "".join(report)
    assert result.attempted >= 10


@pytest.mark.parametrize(
    "command",
    [
        "pip install -c constraints.txt . && torchqm demo",
        "pip install -c constraints.txt -e '.[test]' && pytest",
    ],
)
def test_the_two_commands_are_on_the_first_screen(command):
    assert f"    {command}" in README.splitlines()[:25]


def test_ci_runs_the_test_command():
    script = (ROOT / ".ci" / "run").read_text()
    assert "pip install --quiet -c constraints.txt -e '.[test]'" in script
    assert re.search(r"^pytest$", script, flags=re.MULTILINE)
    assert re.search(r"^torchqm demo", script, flags=re.MULTILINE)


def test_files_that_are_named_exist():
    linked = re.findall(r"\]\(([^)#:]+)\)", README)
    named = re.findall(r"benchmarks/\w+\.py", README)
    assert [name for name in (*linked, *named) if not (ROOT / name).exists()] == []


def test_modules_that_are_named_exist():
    missing = []
    for name in sorted(set(re.findall(r"`(torchqm(?:\.\w+)+)`", README))):
        path = ROOT / name.replace(".", "/")
        if not (path.with_suffix(".py").exists() or path.is_dir()):
            parent, _, attribute = name.rpartition(".")
            module = __import__(parent, fromlist=[attribute])
            if not hasattr(module, attribute):
                missing.append(name)
    assert missing == []


def test_options_that_are_named_exist():
    options = set()
    for action in build_parser()._subparsers._group_actions[0].choices.values():
        options |= set(action._option_string_actions)
    named = set(re.findall(r"`(--[a-z-]+)", README)) - {"--scb"}
    assert named - options - {"--help"} == set()
    assert len(named) >= 7


def test_table_of_keys_is_what_is_written():
    table = README[README.index("`match.npz`") : README.index("`symmetry.npz`: ")]
    described = set(re.findall(r"^\| `(\w+)` \|", table, flags=re.MULTILINE))
    source = (ROOT / "torchqm" / "matching" / "result.py").read_text()
    written = re.search(r"Keys: ``([\w, ]+)``", source)
    assert described == set(written[1].split(", "))


def test_results_have_a_place():
    assert README.count("<!-- results:begin -->") == README.count("<!-- results:end -->") == 1
    assert README.index("<!-- results:begin -->") < README.index("<!-- results:end -->")


def test_results_are_those_of_the_json_files(monkeypatch, capsys):
    script = ROOT / "benchmarks" / "readme_tables.py"
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script), "--check"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 0, capsys.readouterr()
