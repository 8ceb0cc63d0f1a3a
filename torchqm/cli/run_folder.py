"""Where a training or a test writes: a run goes on in its own folder, a test changes nothing that a training wrote."""

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.cli import SaveConfigCallback
from pytorch_lightning.loggers import CSVLogger, Logger, TensorBoardLogger

from torchqm.cli.console import UserError
from torchqm.cli.learn import CONFIG_NAME
from torchqm.cli.yaml_file import read_yaml
from torchqm.learn.callbacks import LAST
from torchqm.learn.logger import RunLogger
from torchqm.learn.run_files import write_version
from torchqm.learn.state import TrainingState

__all__ = ["Place", "RunConfig", "hold", "place_of_test", "place_of_training", "read_config"]

_LOGGER = "--trainer.logger"


@dataclass(frozen=True)
class Place:
    """What a run begins from, and where it writes.

    Args:
        checkpoint: the file that is read; None: begin with new weights.
        loggers: of the trainer, as they are configured if there is no ``folder``.
        folder: of a run that is there already.
    """

    checkpoint: str | None
    loggers: Any
    folder: Path | None = None

    @property
    def goes_on(self) -> bool:
        """Whether the checkpoint is that of the folder: a run whose first epoch was not finished has none."""
        return self.folder is not None and self.checkpoint == str(_last(self.folder))

    def news(self, state: TrainingState | None, most: int | None) -> str:
        """What a user is told who did not ask for a new run; empty where there is nothing to tell.

        Args:
            state: of the checkpoint.
            most: epochs that are to be done.
        """
        if self.folder is None:
            return "" if state is None else f"{state.path}: a run of its own begins from this state"
        if state is None or not self.goes_on:
            return f"{self.folder}: no epoch was finished, so that it begins anew"
        done = most is not None and 0 <= most <= state.epochs
        more = "; that is all it was to do, more is done with --trainer.max_epochs N" if done else ""
        return f"{self.folder}: goes on after {state.epochs} epochs, {state.steps} steps{more}"

    def at(self, steps: int) -> "Place":
        """The loggers of a run that is gone on with keep what was logged before so many steps."""
        if self.folder is None:
            return self
        return replace(self, loggers=_in_folder(self.loggers, self.folder, steps))


def place_of_training(
    checkpoint: str | None,
    loggers: Any,
    words: Sequence[str],
    resumed: Path | None,
    same_run: Callable[[Path], bool],
) -> Place:
    """The place of a training.

    With ``--resume RUN`` it is RUN, from its last whole epoch; from the beginning where there is none. ``--ckpt_path
    RUN/checkpoints/last.ckpt`` is the same if the config is that of RUN and no other folder is asked for. Any other
    checkpoint begins a run in a folder of its own.

    Args:
        checkpoint: option ``ckpt_path``.
        loggers: of the config.
        words: of the command line.
        resumed: RUN.
        same_run: whether the config trains the same as that of a run folder.

    Raises:
        UserError: a folder would get a second run, from an earlier state.
    """
    if resumed is not None:
        found = str(_last(resumed)) if _last(resumed).is_file() else checkpoint
        return Place(found, _in_folder(loggers, resumed), resumed)
    run = _run_of(checkpoint)
    if checkpoint is None or run is None:
        return Place(checkpoint, loggers)
    there = _same(_folder_of(loggers), run)
    if Path(checkpoint).name == LAST and (there or (not _named(words) and same_run(run))):
        return Place(str(_last(run)), _in_folder(loggers, run), run)
    if there:
        raise UserError(
            f"{checkpoint}: not the last state of {run}, so that what came after it would be lost if it went on there; "
            f"give another {_LOGGER}.init_args.version"
        )
    return Place(checkpoint, loggers)


def place_of_test(checkpoint: str | None, loggers: Any, words: Sequence[str]) -> Place:
    """The place of a test: ``RUN/test/version_N``, unless the command line names another that has no training in it."""
    run = _run_of(checkpoint)
    if run is None or _named(words):
        run = _folder_of(loggers)
        if run is None or not ((run / "checkpoints").is_dir() or (run / "versions.json").is_file()):
            return Place(checkpoint, loggers)
    if not loggers:
        return Place(checkpoint, loggers)
    given = loggers if isinstance(loggers, list) else [loggers]
    own = next((logger for logger in given if isinstance(logger, RunLogger)), None) or RunLogger()
    # Others that write files would write them into the folder of the training.
    others = [v for v in given if isinstance(v, Logger) and not isinstance(v, CSVLogger | TensorBoardLogger)]
    return Place(checkpoint, [own.moved(run / "test", None), *others])


class RunConfig(SaveConfigCallback):
    """Writes ``config.yaml`` into the run folder; one with other values that is there is kept as ``config-1.yaml``."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Once, before anything else of the run; nothing without a logger, since there is no run folder then."""
        given = trainer.log_dir if trainer.loggers else None  # asks all processes
        if given is None or self.already_saved:
            return
        self.already_saved = True
        if trainer.is_global_zero:
            write_version(Path(given) / CONFIG_NAME, self.parser.dump(self.config, skip_none=False))


def hold(folder: Path) -> AbstractContextManager[Any]:
    """Hold a run folder, made if need be: two runs in it would write into each other's metrics and checkpoints.

    Raises:
        UserError: another process holds it, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return FileLock(folder / ".lock", timeout=0).acquire()
    except Timeout as error:
        raise UserError(f"{folder}: another training is writing there") from error
    except OSError as error:
        raise UserError(f"{folder}: the run folder cannot be made ({error.strerror or error})") from error


def read_config(folder: Path) -> dict[str, Any]:
    """The configuration in a run folder.

    Raises:
        UserError: there is none, or it is no YAML of keys and values.
    """
    path = folder / CONFIG_NAME
    if not path.is_file():
        raise UserError(f"{folder}: no folder of a run; {CONFIG_NAME} is missing")
    found = read_yaml(path)
    if not isinstance(found, dict):
        raise UserError(f"{path}: expected keys and values")
    return found


def _run_of(checkpoint: str | None) -> Path | None:
    """RUN of ``RUN/checkpoints/NAME``."""
    if checkpoint is None:
        return None
    path = Path(checkpoint).absolute()
    folder = path.parent.parent
    if not path.is_file() or path.parent.name != "checkpoints" or not (folder / CONFIG_NAME).is_file():
        return None
    return folder if Path(checkpoint).is_absolute() else Path(os.path.relpath(folder))


def _last(folder: Path) -> Path:
    return folder / "checkpoints" / LAST


def _folder_of(loggers: Any) -> Path | None:
    first = loggers[0] if isinstance(loggers, list) and loggers else loggers
    return Path(first.log_dir) if isinstance(first, CSVLogger | TensorBoardLogger) else None


def _in_folder(loggers: Any, folder: Path, steps: int | None = None) -> list[Any]:
    given = loggers if isinstance(loggers, list) else [loggers]
    if not given or not isinstance(given[0], RunLogger):
        raise UserError(
            f"trainer.logger: a run goes on in its folder ({folder}) with {RunLogger.__name__} as first logger"
        )
    return [given[0].moved(folder.parent, folder.name, steps), *given[1:]]


def _named(words: Sequence[str]) -> bool:
    return any(word.startswith(_LOGGER) for word in words)


def _same(first: Path | None, second: Path) -> bool:
    return first is not None and first.resolve() == second.resolve()
