"""The report of a comparison: per-pair rows as CSV, one table in Markdown, the paper's figures as PNG and SVG."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from torchqm.evaluate.curves import curve_thresholds, mean_curve
from torchqm.evaluate.protocol import ErrorReport
from torchqm.evaluate.table import Row, checked_rows, csv_text, markdown_table
from torchqm.geometry.files import write_whole

__all__ = ["FIGURES", "MethodCurve", "write_report"]

FIGURES = {
    "orbit": ("figure6_orbit", "Flips forgiven at every point (Figure 6)"),
    "symmetry": ("figure8_symmetry", "Symmetry detection (Figure 8)"),
    "map": ("figure10_map", "A flip of the whole map forgiven (Figure 10)"),
    "plain": ("figure_plain", "No flip forgiven"),
}
"""File name and title of the figure of each protocol; other keys of ``curves`` name their file and title themselves."""


@dataclass(frozen=True, eq=False)
class MethodCurve:
    """The cumulative error curve of a method: the mean of the curves of its pairs.

    Args:
        thresholds: ``(N,)`` in sqrt(area).
        shares: ``(N,)`` share of points with an error of at most each threshold.
        mean: mean error, for the legend.
        n_pairs: pairs (or shapes) behind both.
        published: whether it was read from a result file; drawn dashed.

    Raises:
        ValueError: if there are not as many shares as thresholds.
    """

    thresholds: Float[Tensor, " N"]
    shares: Float[Tensor, " M"]
    mean: float
    n_pairs: int
    published: bool = False

    def __post_init__(self) -> None:
        if self.thresholds.shape != self.shares.shape:
            raise ValueError(f"shares: expected one for each of {len(self.thresholds)} thresholds: {len(self.shares)}")

    @classmethod
    def from_reports(
        cls, reports: Sequence[ErrorReport], thresholds: Float[Tensor, " N"] | None = None, published: bool = False
    ) -> "MethodCurve":
        """The mean curve of reports of one protocol.

        Raises:
            ValueError: if there are none.

        Example:
            >>> import torch
            >>> from torchqm.evaluate.protocol import make_report
            >>> reports = [make_report("map", torch.tensor([e])) for e in (0.0, 0.2)]
            >>> MethodCurve.from_reports(reports, torch.tensor([0.1, 0.2])).shares.tolist()
            [0.5, 1.0]
        """
        thresholds = curve_thresholds() if thresholds is None else thresholds
        shares = mean_curve([report.curve(thresholds) for report in reports])
        return cls(thresholds, shares, sum(report.mean for report in reports) / len(reports), len(reports), published)


def write_report(
    rows: Sequence[Row],
    curves: Mapping[str, Mapping[str, MethodCurve]],
    out: str | Path,
    title: str = "Comparison",
) -> dict[str, Path]:
    """Write ``pairs.csv``, ``table.md`` and a PNG and an SVG for each figure; every file appears whole or not at all.

    Args:
        rows: one for each pair and method, a mapping with ``method``, ``source`` and ``target``; the numbers under the
            names of :meth:`MapEvaluation.to_row <torchqm.evaluate.evaluation.MapEvaluation.to_row>` and ``seconds`` go
            into the table, everything goes into the CSV. A pair that failed has its ``reason`` and no numbers.
        curves: by protocol (see :data:`FIGURES`), then by method in the order of the legend.
        out: the folder; made if need be. Other files in it stay.
        title: heading of the table.

    Returns:
        The files by name: ``csv``, ``table``, and ``figure6_orbit.png`` and so on.

    Raises:
        ValueError: naming what is wrong with a row or a curve, before any file is written.
        OSError: if the folder cannot be written to.
    """
    checked = checked_rows(rows)
    for figure, methods in curves.items():
        if not methods:
            raise ValueError(f"curves[{figure!r}]: expected one curve or more, got none")
    table = markdown_table(checked, title)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    files = {
        "csv": write_whole(folder / "pairs.csv", lambda file: file.write(csv_text(checked).encode())),
        "table": write_whole(folder / "table.md", lambda file: file.write(table.encode())),
    }
    for figure, methods in curves.items():
        name, heading = FIGURES.get(figure, (figure, figure))
        for kind in ("png", "svg"):
            files[f"{name}.{kind}"] = _draw(methods, folder / f"{name}.{kind}", heading)
    return files


def _draw(methods: Mapping[str, MethodCurve], path: Path, title: str) -> Path:
    """The curves beside their legend: a dozen methods would hide each other's curves behind a legend inside."""
    from torchqm.viz.charts import CYCLE, DASHES, new_figure, save_figure  # on first use: it loads matplotlib

    labels = [f"{name} (mean {curve.mean:.4f}, {curve.n_pairs})" for name, curve in methods.items()]
    figure = new_figure(5.2 + 0.065 * max(len(label) for label in labels), max(3.6, 0.6 + 0.2 * len(labels)))
    figure.set_layout_engine("constrained")
    ax = figure.add_subplot()
    for i, (label, curve) in enumerate(zip(labels, methods.values(), strict=True)):
        # torchqm's own lines are solid, published ones dashed; beyond the colours of the cycle come the other dashes
        turn = 2 * (i // len(CYCLE)) + curve.published
        color, dashes = CYCLE[i % len(CYCLE)], DASHES[turn % len(DASHES)]
        ax.plot(curve.thresholds.numpy(), curve.shares.numpy(), dashes, color=color, linewidth=1.7, label=label)
    upto = max(float(curve.thresholds.max()) for curve in methods.values())
    ax.set(xlim=(0, upto), ylim=(0, 1.01), xlabel="geodesic error / √area", ylabel="share of correspondences")
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#E3E3E3", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.set_title(title, fontsize=11, weight="bold")
    figure.legend(loc="outside right upper", fontsize=8, frameon=False, handlelength=2.6)
    return save_figure(figure, path)
