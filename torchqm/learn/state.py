"""Checkpoints that a training goes on from, or a test reads: looked at before anything is computed or written."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from torchqm.learn.checkpoints import SUFFIX, read_checkpoint
from torchqm.learn.files import differences
from torchqm.learn.options import other_architecture

__all__ = ["TrainingState", "check_state"]

_VERSION = "pytorch-lightning_version"
_NEEDED = ("optimizer_states", "loops", "epoch", "global_step")


@dataclass(frozen=True)
class TrainingState:
    """How far a training has come.

    Args:
        path: the checkpoint.
        epochs: that are done.
        steps: that are done, as the logger counts them.
    """

    path: Path
    epochs: int
    steps: int


def check_state(
    path: str | Path, options: Mapping[str, Any], weights: Mapping[str, Tensor], training: bool
) -> TrainingState:
    """See that a checkpoint fits a module.

    Args:
        path: a ``.ckpt`` of :class:`torchqm.learn.MatchModule`.
        options: of the module, by name (its ``hparams``).
        weights: of the module, its ``state_dict()``.
        training: whether a training shall go on from it, which takes more than weights.

    Raises:
        ValueError: no such file, a URL, damaged, of something else, of another architecture, or weights alone; the
            file is named, and which options differ.
    """
    if "://" in str(path):
        raise ValueError(f"{path}: a URL; a checkpoint is read from a file on this machine")
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; a checkpoint is a file, such as RUN/checkpoints/last.ckpt")
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    if path.suffix == SUFFIX:
        raise ValueError(f"{path}: weights of 'torchqm export'; here a .ckpt of a training run is needed")
    content = read_checkpoint(path)
    _compare_options(path, content["hyper_parameters"], options)
    if faults := differences(weights, content["state_dict"]):
        raise ValueError(f"{path}: weights of another architecture: {faults}")
    if _VERSION not in content:
        raise ValueError(f"{path}: no checkpoint of Lightning ({_VERSION} missing)")
    if training and (missing := [name for name in _NEEDED if name not in content]):
        raise ValueError(f"{path}: weights without the state of a training ({', '.join(missing)} missing)")
    try:
        if not training:
            if "loops" in content:  # weights alone have none
                content["loops"]["test_loop"]
            return TrainingState(path, 0, 0)
        loop = content["loops"]["fit_loop"]
        epochs = int(loop["epoch_progress"]["total"]["processed"])
        return TrainingState(path, epochs, int(loop["epoch_loop.state_dict"]["_batches_that_stepped"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: its state of a training is not that of this version of Lightning") from error


def _compare_options(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    other = [f"{name} is {was} in it and {now} here" for name, was, now in other_architecture(found, wanted)]
    if other:
        raise ValueError(
            f"{path}: of another architecture: model.{', model.'.join(other)}; the configuration that it was trained "
            "with is in the folder of its run"
        )
