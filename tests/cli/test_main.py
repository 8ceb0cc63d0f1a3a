import re
import sys

import pytest

from torchqm.cli import main as module
from torchqm.cli.console import UserError
from torchqm.cli.inputs import _OPTIONS
from torchqm.cli.main import build_parser, main
from torchqm.cli.threads import set_threads
from torchqm.matching import METHODS, MatchParameters
from torchqm.version import __version__


def test_version(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out.splitlines()[0] == f"torchqm {__version__}"


@pytest.mark.parametrize("command", [[], ["demo"], ["match"], ["symmetry"], ["prepare"]])
def test_help_exits_with_0_and_fits_a_terminal(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(" ".join(["usage: torchqm", *command]))
    assert max(map(len, text.splitlines())) <= 110


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["guess"],
        ["match", "a.off"],
        ["match", "a.off", "b.off", "--k", "many"],
        ["match", "a.off", "b.off", "--time", "nan"],
        ["match", "a.off", "b.off", "--threads", "0"],
        ["match", "a.off", "b.off", "--method", "best"],
        ["demo", "--creature", "unicorn"],
    ],
)
def test_wrong_arguments_exit_with_2(argv, capsys):
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 2
    assert "torchqm" in capsys.readouterr().err


def test_defaults_in_the_help_are_those_of_the_parameters():
    plain, paper = MatchParameters(), MatchParameters.paper()
    for option, field, _, text in _OPTIONS:
        given = re.search(r"\(default ([\d.]+)(?:; paper and semi ([\d.]+))?\)$", text)
        assert given, option
        assert float(given[1]) == getattr(plain, field), f"{option}: the help says {given[1]}"
        assert float(given[2] or given[1]) == getattr(paper, field), f"{option}: the help says {given[2] or given[1]}"


def test_methods_are_those_of_the_matcher():
    arguments = build_parser().parse_args(["match", "a", "b"])
    assert arguments.method == "quotient"
    for method in METHODS:
        assert build_parser().parse_args(["match", "a", "b", "--method", method]).method == method


def run_as(monkeypatch, error):
    def fail(arguments):
        raise error

    class Parser:
        def parse_args(self, argv):
            return type("Arguments", (), {"run": staticmethod(fail), "threads": None, "default_threads": None})()

    monkeypatch.setattr(module, "build_parser", lambda: Parser())


def test_user_error_is_one_line_and_status_2(monkeypatch, capsys):
    run_as(monkeypatch, UserError("a.off: broken\nin two lines"))
    assert main([]) == 2
    assert capsys.readouterr().err == "torchqm: error: a.off: broken in two lines\n"


def test_interrupt_is_one_line_and_status_130(monkeypatch, capsys):
    run_as(monkeypatch, KeyboardInterrupt())
    assert main([]) == 130
    assert capsys.readouterr().err == "torchqm: interrupted, nothing was written\n"


def test_a_bug_keeps_its_traceback(monkeypatch):
    run_as(monkeypatch, ValueError("a bug"))
    with pytest.raises(ValueError, match="a bug"):
        main([])


@pytest.mark.parametrize(
    ("given", "default", "before", "after"),
    [(None, None, None, None), (None, 1, None, "1"), (None, 1, "4", "4"), (3, 1, "4", "3"), (3, None, None, "3")],
)
def test_threads_are_what_was_given_else_the_environment_else_the_default(monkeypatch, given, default, before, after):
    monkeypatch.delitem(sys.modules, "numpy")  # as in a fresh process
    environment = {} if before is None else {"OMP_NUM_THREADS": before}
    monkeypatch.setattr("torchqm.cli.threads.os.environ", environment)
    set_threads(given, default)
    assert environment.get("OMP_NUM_THREADS") == after
    assert environment["OMP_WAIT_POLICY"] == "PASSIVE"


def test_threads_of_a_running_process_are_left_alone(monkeypatch):
    environment = {}
    monkeypatch.setattr("torchqm.cli.threads.os.environ", environment)
    set_threads(3, 1)
    assert environment == {}
