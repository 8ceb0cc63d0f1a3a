"""The option ``--checkpoint``: a trained network in the place of wave kernel signatures."""

import argparse
from typing import TYPE_CHECKING

from torchqm.cli.console import UserError, warnings_as_lines

if TYPE_CHECKING:
    from torchqm.learn import LearnedDescriptors

__all__ = ["CHECKPOINT_HELP", "add_checkpoint", "read_checkpoint"]

CHECKPOINT_HELP = (
    "the folder of a training run (its best checkpoint is taken, else its last), a .ckpt in it, a .safetensors of "
    "'torchqm export', or 'builtin', which ships with torchqm"
)


def add_checkpoint(parser: argparse.ArgumentParser) -> None:
    """The option ``--checkpoint``."""
    parser.add_argument(
        "--checkpoint",
        metavar="RUN|FILE|builtin",
        help=f"use learned features as descriptors instead of --descriptor: {CHECKPOINT_HELP}",
    )


def read_checkpoint(path: str | None) -> "LearnedDescriptors | None":
    """The descriptors of a trained network; None if there is no path.

    Raises:
        UserError: a file that cannot be used, with its name and fault.
    """
    if path is None:
        return None
    from torchqm.learn import LearnedDescriptors, load_net

    try:
        with warnings_as_lines():
            return LearnedDescriptors(load_net(path))
    except ValueError as error:
        raise UserError(str(error)) from error
