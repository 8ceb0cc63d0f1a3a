"""What a run writes beside its metrics."""

import json
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint

from torchqm.geometry.files import write_whole
from torchqm.version import __version__

__all__ = ["LastEpoch", "Versions", "versions"]

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


class LastEpoch(ModelCheckpoint):
    """Keeps ``last.ckpt``, the state after the last whole epoch: what a run that was stopped goes on from.

    Lightning's own ``save_last`` writes it only where a monitored value got better.

    Args:
        dirpath: folder; ``checkpoints`` in the run folder if not given.
    """

    def __init__(self, dirpath: str | Path | None = None) -> None:
        super().__init__(dirpath, "last", save_on_train_epoch_end=True, enable_version_counter=False)


class Versions(Callback):
    """Writes ``versions.json`` into the run folder, once; a resumed run adds nothing."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Before anything else of the run."""
        given = trainer.log_dir  # asks all processes, so all must come here, and once each
        if given is None or not trainer.is_global_zero or stage != "fit":
            return
        folder = Path(given)
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(versions(), indent=2) + "\n"
        write_whole(folder / "versions.json", lambda file: file.write(text.encode()))
