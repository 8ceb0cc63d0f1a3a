"""Charts (error curves, lines, bars), and the making and atomic saving of every figure; pyplot is never touched."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Shaped
from torch import Tensor

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

from torchqm.geometry.files import write_whole

__all__ = ["bar_figure", "curve_points", "error_curves", "line_figure", "new_figure", "save_figure"]

# Okabe and Ito's colours, told apart by colour-blind readers; their yellow is left out, it does not show on white
CYCLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES = ("-", "--", "-.", ":")
DPI = 200


def new_figure(width: float | int, height: float | int) -> "matplotlib.figure.Figure":
    """A white figure of ``width`` by ``height`` inches that no pyplot state knows of.

    Args:
        width: inches.
        height: inches.

    Returns:
        The figure, on an Agg canvas, at 200 dots per inch.

    Example:
        >>> new_figure(4, 3).canvas.get_width_height()
        (800, 600)
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "matplotlib.figure.Figure", path: str | Path) -> Path:
    """Write a figure beside its destination, then rename it, so that it appears whole or not at all; then clear it.

    Args:
        figure: the figure.
        path: where to; the ending says the format, missing folders are made.

    Returns:
        ``path``.

    Raises:
        ValueError: if the ending is no picture format.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    allowed = sorted(figure.canvas.get_supported_filetypes())
    if kind not in allowed:
        raise ValueError(f"path: given {str(path)!r}; allowed are names that end in {', '.join(allowed)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        write_whole(path, lambda file: figure.savefig(file, format=kind, dpi=DPI))
    finally:
        figure.clear()
    return path


def curve_points(
    errors: Shaped[Tensor, "..."] | Shaped[np.ndarray, "..."] | Sequence[float], xlim: float | int = 0.25
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """The field's error curve ``y(x) = |{i : e_i <= x}| / n`` at 501 evenly spaced x.

    Args:
        errors: n errors, usually geodesic distance over sqrt(area of the target).
        xlim: the largest x.

    Returns:
        ``x`` and ``y``, the share of correspondences with an error of at most x.

    Raises:
        ValueError: if ``errors`` is not a non-empty row of finite numbers of at least 0.

    Example:
        >>> x, y = curve_points([0.0, 0.1, 0.3], xlim=0.2)
        >>> [round(float(y[i]), 3) for i in (0, 249, 250, 500)]
        [0.333, 0.333, 0.667, 0.667]
    """
    values = _numpy(errors).astype(np.float64)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"errors: given shape {values.shape}; allowed is (n,) with n >= 1")
    if not (np.isfinite(values) & (values >= 0)).all():
        raise ValueError("errors: given NaN, infinite or negative numbers; allowed are finite ones of at least 0")
    if not xlim > 0:
        raise ValueError(f"xlim: given {xlim}; allowed are positive numbers")
    x = np.linspace(0.0, xlim, 501)
    return x, np.searchsorted(np.sort(values), x * (1 + 1e-12), side="right") / len(values)


def error_curves(
    curves: Mapping[str, Shaped[Tensor, "..."] | Shaped[np.ndarray, "..."] | Sequence[float]],
    path: str | Path,
    xlim: float | int = 0.25,
    title: str | None = None,
    xlabel: str = "geodesic error / √area",
) -> Path:
    """Draw cumulative error curves, the mean error of each in the legend.

    Args:
        curves: name to n errors (all of them, also those beyond ``xlim``, count in the mean and in the share).
        path: the picture.
        xlim: the largest error on the axis.
        title: a line above the figure.
        xlabel: name of the error axis.

    Returns:
        ``path``.

    Raises:
        ValueError: if ``curves`` is empty, a curve is no row of errors (named), or ``path`` does not fit.

    References:
        Kim, Lipman and Funkhouser 2011, Section 6; Ovsjanikov et al. 2013, Figures 6, 8 and 10.
    """
    if not curves:
        raise ValueError("curves: given none; allowed is at least one")
    figure = new_figure(4.6, 3.5)
    ax = _axes(figure, xlabel, "share of correspondences", title)
    for i, (name, errors) in enumerate(curves.items()):
        try:
            x, y = curve_points(errors, xlim)
        except ValueError as error:
            raise ValueError(f"curves[{name!r}]: {error}") from error
        ax.plot(x, y, label=f"{name} (mean {_numpy(errors).mean():.4f})", **_look(i))
    ax.set(xlim=(0, xlim), ylim=(0, 1.01))
    ax.legend(loc="lower right", fontsize=8, frameon=True, framealpha=0.85, edgecolor="none", handlelength=2.6)
    return save_figure(figure, path)


def line_figure(
    series: Mapping[str, tuple[Any, Any]],
    path: str | Path,
    xlabel: str,
    ylabel: str,
    styles: Mapping[str, Mapping[str, Any]] | None = None,
    title: str | None = None,
    yscale: str = "linear",
) -> Path:
    """Draw lines.

    Args:
        series: name to ``(x, y)``, two rows of equal length.
        path: the picture.
        xlabel: name of the x axis.
        ylabel: name of the y axis.
        styles: name to line properties of matplotlib (``color``, ``linestyle``, ``marker``, ...) over the cycle's.
        title: a line above the figure.
        yscale: ``"linear"`` or ``"log"``.

    Returns:
        ``path``.

    Raises:
        ValueError: if ``series`` is empty or a pair does not fit, ``styles`` names no series, or ``path`` does not fit.

    References:
        Ovsjanikov et al. 2013, Figures 3 and 4.
    """
    if not series:
        raise ValueError("series: given none; allowed is at least one")
    if unknown := sorted(set(styles or {}) - set(series)):
        raise ValueError(f"styles: given {', '.join(unknown)}; allowed are {', '.join(series)}")
    if yscale not in ("linear", "log"):
        raise ValueError(f"yscale: given {yscale!r}; allowed are 'linear', 'log'")
    figure = new_figure(4.6, 3.5)
    ax = _axes(figure, xlabel, ylabel, title)
    for i, (name, pair) in enumerate(series.items()):
        x, y = (_numpy(values) for values in pair)
        if x.ndim != 1 or x.shape != y.shape:
            raise ValueError(
                f"series[{name!r}]: given x {x.shape} and y {y.shape}; allowed are two rows of equal length"
            )
        ax.plot(x, y, label=name, **(_look(i) | dict((styles or {}).get(name, {}))))
    ax.set_yscale(yscale)
    ax.margins(x=0.02)
    ax.legend(fontsize=8, frameon=True, framealpha=0.85, edgecolor="none", handlelength=2.6)
    return save_figure(figure, path)


def bar_figure(
    groups: Mapping[str, Mapping[str, float | int]], path: str | Path, ylabel: str, title: str | None = None
) -> Path:
    """Draw bars in groups, such as one group a class and one bar a method.

    Args:
        groups: group name to (bar name to height); a bar may be missing in a group.
        path: the picture.
        ylabel: name of the y axis.
        title: a line above the figure.

    Returns:
        ``path``.

    Raises:
        ValueError: if ``groups`` has no bar, or ``path`` does not fit.
    """
    names = list(dict.fromkeys(name for bars in groups.values() for name in bars))
    if not names:
        raise ValueError("groups: given no bars; allowed is at least one")
    figure = new_figure(max(4.6, 1.2 + 0.9 * len(groups)), 3.3)
    ax = _axes(figure, "", ylabel, title)
    wide = 0.8 / len(names)
    for i, name in enumerate(names):
        at = [k + (i - (len(names) - 1) / 2) * wide for k, bars in enumerate(groups.values()) if name in bars]
        heights = [float(bars[name]) for bars in groups.values() if name in bars]
        ax.bar(at, heights, 0.92 * wide, label=name, color=CYCLE[i % len(CYCLE)], zorder=2)
    ax.set_xticks(range(len(groups)), list(groups))
    ax.grid(visible=False, axis="x")
    ax.margins(y=0.18)
    ax.legend(fontsize=8, frameon=False, ncols=3, loc="upper right")
    return save_figure(figure, path)


def _axes(figure: "matplotlib.figure.Figure", xlabel: str, ylabel: str, title: str | None) -> "matplotlib.axes.Axes":
    """The one axes of a chart: two spines, light grid, small print."""
    figure.set_layout_engine("constrained")
    ax = figure.add_subplot()
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_linewidth(0.8)
    ax.grid(color="#E3E3E3", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=9, width=0.8, length=3)
    ax.set_xlabel(xlabel, fontsize=10)
    ax.set_ylabel(ylabel, fontsize=10)
    if title:
        ax.set_title(title, fontsize=11, weight="bold")
    return ax


def _look(i: int) -> dict[str, Any]:
    """Colour and dashes of the i-th line: all colours solid first, then all dashed, and so on."""
    return {
        "color": CYCLE[i % len(CYCLE)],
        "linestyle": DASHES[i // len(CYCLE) % len(DASHES)],
        "linewidth": 1.7,
    }


def _numpy(values: object) -> np.ndarray:
    """The array behind a tensor or anything array-like."""
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
