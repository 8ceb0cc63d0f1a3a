"""Pictures of a training: curves of what was logged."""

import csv
from collections.abc import Sequence
from pathlib import Path

from torchqm.viz.charts import CYCLE, new_figure, save_figure

__all__ = ["PANELS", "read_metrics", "training_curves"]

PANELS = (
    ("loss", ("train_loss", "val_loss")),
    ("mean error / √area", ("val_plain_error", "val_orbit_error")),
    ("flip rate", ("val_flipped_map", "val_flipped_points")),
)
"""What is drawn: the name of an axis, and the columns on it."""


def read_metrics(path: str | Path) -> dict[str, list[tuple[float, float]]]:
    """``(epoch, value)`` of each column of a ``metrics.csv``, in the order of its rows; empty cells are left out.

    Raises:
        ValueError: no table with a column ``epoch``.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    with Path(path).open(newline="") as file:
        reader = csv.DictReader(file)
        if "epoch" not in (reader.fieldnames or ()):
            raise ValueError(f"{path}: no table of metrics, a column 'epoch' is missing")
        for row in reader:
            for name, cell in row.items():
                if cell and name not in ("epoch", "step"):
                    found.setdefault(name, []).append((float(row["epoch"]), float(cell)))
    return found


def training_curves(metrics: str | Path, path: str | Path, title: str | None = None) -> Path | None:
    """Draw loss, errors and flip rates over the epochs.

    Args:
        metrics: a ``metrics.csv`` of a run.
        path: the picture.
        title: a line above it.

    Returns:
        ``path``; None, and nothing drawn, if the table has none of the columns of :data:`PANELS`.

    Raises:
        ValueError: as :func:`read_metrics`, or ``path`` is no picture's name.
    """
    found = read_metrics(metrics)
    panels = [(label, [name for name in names if name in found]) for label, names in PANELS]
    panels = [(label, names) for label, names in panels if names]
    if not panels:
        return None
    figure = new_figure(3.6 * len(panels), 3.0)
    for number, (label, names) in enumerate(panels):
        ax = figure.add_subplot(1, len(panels), number + 1)
        for color, name in zip(CYCLE, names, strict=False):
            epochs, values = zip(*found[name], strict=True)
            ax.plot(epochs, values, color=color, marker=".", markersize=4, label=name)
        ax.set(xlabel="epoch", ylabel=label)
        if label != "loss" or not _positive([value for name in names for _, value in found[name]]):
            ax.set_ylim(bottom=0)
        else:
            ax.set_yscale("log")
        ax.grid(alpha=0.25)
        ax.legend(fontsize=7, frameon=False)
    if title:
        figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    return save_figure(figure, path)


def _positive(values: Sequence[float]) -> bool:
    return all(value > 0 for value in values)
