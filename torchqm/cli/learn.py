"""Training and testing from YAML: one LightningCLI; needs the extra ``learn`` (pytorch-lightning, jsonargparse)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchqm.cli.console import UserError

if TYPE_CHECKING:
    from pytorch_lightning.cli import LightningCLI

__all__ = ["evaluate", "fit", "learn"]

CONFIG_NAME = "config.yaml"


def learn(args: Sequence[str], run: bool = True) -> "LightningCLI":
    """Parse ``fit --config FILE ...`` or ``test ...`` and do it.

    Args:
        args: what stands on the command line, the name of the subcommand first.
        run: false: parse, build everything, do nothing; then ``args`` has no subcommand.

    Raises:
        ImportError: the extra is not installed.
        UserError: an argument or a file that is wrong, with the nearest key that is right; a run that cannot go on.
    """
    try:
        from torchqm.cli.lightning import MatchCLI
    except ImportError as error:
        raise ImportError(f"learning needs the extra 'learn' (pip install 'torchqm[learn]'): {error}") from error
    return MatchCLI.start(list(args), run)


def fit(args: Sequence[str]) -> "LightningCLI":
    """Train: ``--config FILE [--model.lr 1e-3 ...] [--ckpt_path RUN/checkpoints/last.ckpt]``."""
    return learn(["fit", *args])


def evaluate(args: Sequence[str]) -> "LightningCLI":
    """Test: ``RUN [--data.root ...]``, RUN the folder of a training; its best checkpoint, or its last, is taken.

    Raises:
        UserError: the folder is no run, or has no checkpoint.
    """
    if not args or args[0].startswith("-"):
        return learn(["test", *args])
    folder = Path(args[0])
    if not (folder / CONFIG_NAME).is_file():
        raise UserError(f"{folder}: no folder of a run; {CONFIG_NAME} is missing")
    from torchqm.learn.files import find_weights

    try:
        found = find_weights(folder)
    except ValueError as error:
        raise UserError(str(error)) from error
    own = ["--config", str(folder / CONFIG_NAME), "--ckpt_path", str(found)]
    return learn(["test", *own, *args[1:]])
