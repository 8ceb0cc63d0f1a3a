"""``torchqm fit`` and ``torchqm test``: the commands in front of the LightningCLI of :mod:`torchqm.cli.learn`."""

import argparse
import sys
from collections.abc import Callable, Sequence
from shlex import quote
from typing import Any

from torchqm.cli.console import UserError

__all__ = ["add_parser", "run_fit", "run_test"]


def add_parser(commands: Any) -> None:
    """Add both commands; what follows them is parsed by the LightningCLI, when it is needed."""
    for name, run, text in (
        ("fit", run_fit, "train a matcher: fit --config FILE [--model.lr 1e-3 ...], or go on: fit --resume RUN"),
        ("test", run_test, "test a trained matcher: test RUN [--data.test_root ...]"),
    ):
        # No argument begins with a NUL, so argparse takes none for an option of its own, --help included.
        parser = commands.add_parser(name, help=text, add_help=False, prefix_chars="\0", allow_abbrev=False)
        parser.add_argument("arguments", nargs=argparse.REMAINDER)
        parser.set_defaults(run=run, threads=None, default_threads=None)


def run_fit(arguments: argparse.Namespace) -> int:
    """Train; 130 if it was interrupted, else 0."""
    from torchqm.cli.learn import fit

    return _run(fit, arguments.arguments)


def run_test(arguments: argparse.Namespace) -> int:
    """Test; likewise."""
    from torchqm.cli.learn import evaluate

    return _run(evaluate, arguments.arguments)


def _run(command: Callable[[Sequence[str]], Any], args: Sequence[str]) -> int:
    try:
        command(args)
    except ImportError as error:
        if "torchqm[learn]" not in str(error):
            raise
        raise UserError(str(error)) from error
    except SystemExit as stop:
        if stop.code != 1:  # Lightning's answer to an interrupt, after the callbacks have had their say
            raise
        folder = getattr(stop, "folder", None)
        on = f"; the run folder {folder} is kept, 'torchqm fit --resume {quote(str(folder))}' goes on" if folder else ""
        print(f"torchqm: interrupted{on}", file=sys.stderr)
        return 130
    return 0
