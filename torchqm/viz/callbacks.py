"""Callbacks that draw while a matcher is trained; they need the extra ``learn`` (pytorch-lightning)."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer

from torchqm.geometry import Mesh
from torchqm.viz.plots import match_figure
from torchqm.viz.training import training_curves

__all__ = ["Curves", "PairPictures", "draw_pair"]


def draw_pair(net: Any, batch: Mapping[str, Any], path: str | Path, number: int = 0) -> Path:
    """Draw what a network makes of one pair: the colours of the second shape, carried to the first.

    Args:
        net: a :class:`torchqm.learn.MatchNet`.
        batch: pairs of :func:`torchqm.data.collate`.
        path: the picture.
        number: which of the pairs.

    Returns:
        ``path``.
    """
    x, y = ({key: _row(value, number) for key, value in batch[side].items()} for side in ("first", "second"))
    with torch.no_grad():
        matched = net(x, y)
        p2p = matched.maps.points(y["verts_mask"])[0].cpu()
        known = "corr" in x and bool(x["corr_mask"].any())
        errors = net.errors({"first": x, "second": y}, matched) if known else {}
    names = ("orbit_error", "flipped_points")  # a line each: the figure is narrow
    shown = "".join(f"\n{name.replace('_', ' ')} {errors[name].item():.3f}" for name in names if name in errors)
    source, target = _mesh(x), _mesh(y)
    label = "one of each orbit" if net.options.setup == "quotient" else "learned"
    title = f"{source.name} to {target.name}{shown}"
    return match_figure(source, target, p2p[None, : source.n_verts], [label], path, title=title)


class PairPictures(Callback):
    """Draws the map of the first validation pair into ``pictures/`` of the run folder every few epochs.

    Args:
        every: epochs; 0 for never.
    """

    def __init__(self, every: int = 10) -> None:
        if every < 0:
            raise ValueError(f"every: {every} given, expected a number of epochs from 0 on")
        self.every = every
        self._folder: Path | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Ask for the folder where all processes are asked."""
        self._folder = _folder_of(trainer)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw, if it is time."""
        if not self.every or batch_idx or self._folder is None or trainer.sanity_checking:
            return
        epoch = trainer.current_epoch + 1
        last = trainer.max_epochs is not None and epoch == trainer.max_epochs
        if not trainer.is_global_zero or (epoch % self.every and not last):
            return
        names = (batch[side]["name"][0] for side in ("first", "second"))
        pair = "-to-".join(re.sub(r"[^\w.-]+", "_", name) for name in names)
        draw_pair(pl_module.net, batch, self._folder / "pictures" / f"epoch-{epoch:04d}-{pair}.png")


class Curves(Callback):
    """Draws ``curves.png`` from ``metrics.csv``, both in the run folder, when a training ends or is stopped."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Ask for the folder where all processes are asked."""
        self._folder = _folder_of(trainer) if stage == "fit" else None

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw."""
        self._draw(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Draw what there is."""
        self._draw(trainer)

    def _draw(self, trainer: Trainer) -> None:
        if self._folder is None or not trainer.is_global_zero:
            return
        for logger in trainer.loggers:
            logger.save()
        if (self._folder / "metrics.csv").is_file():
            training_curves(self._folder / "metrics.csv", self._folder / "curves.png", self._folder.name)


def _folder_of(trainer: Trainer) -> Path | None:
    """The run folder; None without a logger, where Lightning would say the working directory."""
    folder = trainer.log_dir if trainer.loggers else None
    return None if folder is None else Path(folder)


def _row(value: Any, number: int) -> Any:
    """One of a batch, still as a batch."""
    if isinstance(value, torch.Tensor) and value.layout != torch.strided:
        return value.index_select(0, torch.tensor([number], device=value.device))
    return value[number : number + 1]


def _mesh(item: Mapping[str, Any]) -> Mesh:
    faces = item["faces"][0] if "faces_mask" not in item else item["faces"][0][item["faces_mask"][0]]
    return Mesh(item["verts"][0][item["verts_mask"][0]].double().cpu(), faces.cpu(), name=item["name"][0])
