"""The ``torchqm`` command: its arguments, and what becomes of errors."""

import argparse
import os
import sys
from collections.abc import Sequence

from torchqm.cli import benchmark, data, demo, export, match, predict, prepare, symmetry, training
from torchqm.cli.console import UserError
from torchqm.cli.threads import set_threads
from torchqm.native import available
from torchqm.version import __version__

__all__ = ["build_parser", "main"]

_DESCRIPTION = """\
Shape matching that knows about symmetry: from two triangle meshes, all the equally
good dense maps between them (Ovsjanikov et al., "Shape Matching via Quotient Spaces",
2013)."""

_EPILOG = """\
first steps:
  torchqm demo                                  two built-in creatures, checked against the exact truth
  torchqm match cat3.off cat0.off --out result  all maps from cat3 to cat0
  torchqm match cat3.off cat5.off --reference cat0.off
                                                neither pose has a mirror plane, but cat0 has one
  torchqm symmetry cat3.off --reference cat0.off
  torchqm data check FOLDER                     what a data set holds, and what is wrong with it
  torchqm prepare FOLDER                        eigenfunctions of all its shapes, kept for later runs
  torchqm benchmark FOLDER                      methods compared on its pairs; FOLDER may be 'synthetic:'
  torchqm fit --config FILE                     train a matcher (needs torchqm[learn])
  torchqm fit --resume RUN                      go on with a training that was stopped
  torchqm test RUN                              test it
  torchqm match cat3.off cat0.off --checkpoint builtin
                                                with learned descriptors

'torchqm COMMAND --help' explains a command. Exit status: 0 done, 1 some shapes of a
data set could not be used (the others were), 2 wrong input (one line on stderr says which
file and what is wrong with it; nothing is written), 130 interrupted."""


class _Version(argparse.Action):
    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        parts = ", ".join(available()) or "none; functional maps and eigenpairs take longer"
        print(f"torchqm {__version__}\ncompiled parts: {parts}")
        parser.exit()


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; importing and building it takes no torch."""
    parser = argparse.ArgumentParser(
        prog="torchqm",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, help="what is installed, and exit")
    commands = parser.add_subparsers(metavar="COMMAND", dest="command", required=True)
    for module in (demo, match, symmetry, data, prepare, benchmark, training, predict, export):
        module.add_parser(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: arguments after the program's name; by default those of the process.

    Returns:
        0 if it was done, 2 if the input was at fault, 130 if it was interrupted; what else a command's help says.

    Raises:
        SystemExit: from argparse, with status 0 for ``--help`` and 2 for arguments it does not know.
    """
    try:
        arguments = build_parser().parse_args(argv)  # may read a file of options
        set_threads(arguments.threads, arguments.default_threads)
        status = arguments.run(arguments)
    except UserError as error:
        print(f"torchqm: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("torchqm: interrupted, nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `torchqm match ... | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return status or 0


if __name__ == "__main__":
    sys.exit(main())
