"""Training and testing from YAML: one LightningCLI; needs the extra ``learn`` (pytorch-lightning, jsonargparse)."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchqm.cli.console import UserError, warnings_as_lines
from torchqm.cli.yaml_file import read_yaml

if TYPE_CHECKING:
    from pytorch_lightning.cli import LightningCLI

__all__ = ["CONFIG_NAME", "Interrupted", "evaluate", "fit", "learn"]

CONFIG_NAME = "config.yaml"
"""The resolved configuration in a run folder."""


class Interrupted(SystemExit):
    """A run was interrupted; ``folder`` is that of a training, None if there is nothing to go on with."""

    def __init__(self, folder: str | None) -> None:
        super().__init__(1)
        self.folder = folder if folder is not None and (Path(folder) / CONFIG_NAME).is_file() else None


def learn(args: Sequence[str], run: bool = True, resume: Path | None = None) -> "LightningCLI":
    """Parse ``fit --config FILE ...`` or ``test ...`` and do it.

    Args:
        args: what stands on the command line, the name of the subcommand first.
        run: false: parse, build everything, do nothing; then ``args`` has no subcommand.
        resume: folder of a run that is gone on with; its config is among ``args``.

    Raises:
        ImportError: the extra is not installed.
        UserError: an argument or a file that is wrong, with the nearest key that is right; a run that cannot go on.
    """
    try:
        from torchqm.cli.lightning import MatchCLI
    except ImportError as error:
        raise ImportError(f"learning needs the extra 'learn' (pip install 'torchqm[learn]'): {error}") from error
    return MatchCLI.start(list(args), run, resume)


def fit(args: Sequence[str]) -> "LightningCLI":
    """Train: ``--config FILE [--model.lr 1e-3 ...]``, or go on: ``--resume RUN [--trainer.max_epochs 40 ...]``.

    A run goes on in its folder, from the last whole epoch to what it would have come to without the stop.

    Raises:
        UserError: RUN is no folder of a run.
    """
    rest, folder = _resume(args)
    if folder is None:
        return learn(["fit", *args])
    for word in rest:
        if re.match(r"--trainer\.logger\.(init_args\.)?(save_dir|name|version)(=|$)", word):
            raise UserError(
                f"--resume, {word.partition('=')[0]}: give one of them; a run goes on in its own folder, {folder}, and "
                f"with --ckpt_path {folder}/checkpoints/last.ckpt a run in another folder begins from its state"
            )
    return learn(["fit", "--config", str(_config(folder)), *rest], resume=folder)


def evaluate(args: Sequence[str]) -> "LightningCLI":
    """Test: ``RUN [--data.root ...]``, RUN the folder of a training; its best checkpoint, or its last, is taken.

    Raises:
        UserError: the folder is no run, or has no checkpoint.
    """
    if not args or args[0].startswith("-"):
        return learn(["test", *args])
    config = _config(Path(args[0]))
    from torchqm.learn.checkpoints import find_weights

    try:
        with warnings_as_lines():
            found = find_weights(config.parent)
    except ValueError as error:
        raise UserError(str(error)) from error
    return learn(["test", "--config", str(config), "--ckpt_path", str(found), *args[1:]])


def _config(folder: Path) -> Path:
    if not (folder / CONFIG_NAME).is_file():
        raise UserError(f"{folder}: no folder of a run; {CONFIG_NAME} is missing")
    try:
        found = read_yaml(folder / CONFIG_NAME)
    except UserError:
        return folder / CONFIG_NAME  # the parser says what is wrong
    if isinstance(found, dict) and "verbose" in found:  # an option of a test only
        tested = Path(str(found.get("ckpt_path"))).parent.parent
        run = f"; the run that was tested is {tested}" if (tested / CONFIG_NAME).is_file() else ""
        raise UserError(f"{folder}: the folder of a test, not of a training{run}")
    return folder / CONFIG_NAME


def _resume(args: Sequence[str]) -> tuple[list[str], Path | None]:
    """The arguments without ``--resume RUN``, and RUN."""
    rest, folder = list(args), None
    for number, word in enumerate(args):
        name, equals, value = word.partition("=")
        if name != "--resume":
            continue
        if not equals and (number + 1 == len(args) or args[number + 1].startswith("-")):
            raise UserError("--resume: the folder of a run is needed")
        folder = Path(value if equals else args[number + 1])
        rest = [*args[:number], *args[number + (1 if equals else 2) :]]
    if folder is not None and any(word.split("=")[0] == "--ckpt_path" for word in rest):
        raise UserError("--resume, --ckpt_path: give one of them; a run goes on from its own last checkpoint")
    return rest, folder
