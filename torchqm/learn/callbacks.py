"""What a run writes beside its metrics."""

import json
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import Checkpoint, ModelCheckpoint

from torchqm.learn.run_files import write_version
from torchqm.version import __version__

__all__ = ["LAST", "BestCheckpoint", "LastEpoch", "Versions", "versions"]

LAST = "last.ckpt"
"""The file of :class:`LastEpoch`."""

_PART = f"{LAST}.part"

_PACKAGES = ("torch", "pytorch-lightning", "jsonargparse", "numpy", "scipy")


def versions() -> dict[str, str]:
    """What this process runs on: torchqm, Python, the machine, and the packages that the numbers depend on."""
    found = {"torchqm": __version__, "python": platform.python_version(), "machine": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


class BestCheckpoint(ModelCheckpoint):
    """Keeps the best checkpoints by a metric, as Lightning's ``ModelCheckpoint`` does it.

    A run that goes on in its own folder (:meth:`return_to_folder`) remembers its best checkpoints and scores, also
    if the folder was moved, or is named from elsewhere. A run in a new folder that starts from the state of another
    has none yet.
    """

    _goes_on = False

    def return_to_folder(self, goes_on: bool) -> None:
        """Expect the files of a run that was stopped: those of epochs that are computed again are replaced.

        Args:
            goes_on: from a state of that run, of which the best checkpoints are remembered; a state does not say where
                it was read from.
        """
        self._goes_on, self._enable_version_counter = goes_on, False

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Remember, under the names that files have now."""
        if not self._goes_on:
            return
        names = ("best_model_path", "kth_best_model_path", "last_model_path")
        paths = {name: self._here(state_dict[name]) for name in names}
        best = {self._here(path): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict({**state_dict, **paths, "best_k_models": best, "dirpath": self.dirpath})

    def _here(self, path: str) -> str:
        return str(Path(self.dirpath or "", Path(path).name)) if path else ""


class LastEpoch(Checkpoint):
    """Keeps ``last.ckpt``, the state after the last whole epoch: what a run that was stopped goes on from.

    Lightning's own ``save_last`` writes it only where a monitored value got better, and before the row of the epoch is
    in ``metrics.csv``. Here the file gets its name when that is done: where there is a ``last.ckpt``, a kill has taken
    nothing of what came before it.

    Args:
        dirpath: folder; ``checkpoints`` in the run folder if not given.
    """

    def __init__(self, dirpath: str | Path | None = None) -> None:
        self.dirpath = dirpath
        self._folder: Path | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Ask for the folder where all processes are asked."""
        above = trainer.log_dir if trainer.loggers else trainer.default_root_dir
        if above is not None:  # as it is for a run that only tries whether the code does, fast_dev_run
            self._folder = Path(above, "checkpoints") if self.dirpath is None else Path(self.dirpath)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the state; all processes take part."""
        if self._folder is not None:
            trainer.save_checkpoint(self._folder / _PART, weights_only=False)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The epoch before this one is logged."""
        self._name(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The last one is logged."""
        self._name(trainer)

    def _name(self, trainer: Trainer) -> None:
        if self._folder is None or not trainer.is_global_zero:
            return
        for logger in trainer.loggers:
            logger.save()
        if (part := self._folder / _PART).exists():
            part.replace(self._folder / LAST)


class Versions(Callback):
    """Writes ``versions.json`` into the run folder; a run that goes on with other versions keeps the earlier ones."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Before anything else of the run."""
        given = trainer.log_dir  # asks all processes, so all must come here, and once each
        if given is None or not trainer.is_global_zero or stage != "fit":
            return
        write_version(Path(given) / "versions.json", json.dumps(versions(), indent=2) + "\n")
