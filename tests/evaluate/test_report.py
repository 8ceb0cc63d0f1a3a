"""The files of a report: what they are called, what is in them, and that they appear whole or not at all."""

from pathlib import Path
from xml.etree import ElementTree

import matplotlib.figure
import pytest
import torch
from PIL import Image

from torchqm.evaluate.protocol import make_report
from torchqm.evaluate.report import MethodCurve, write_report
from torchqm.viz import charts

ROWS = [{"method": "ours", "source": "a", "target": "b", "map_mean": 0.1}]
THRESHOLDS = torch.tensor([0.0, 0.1, 0.2])
OURS = MethodCurve(THRESHOLDS, torch.tensor([0.1, 0.5, 1.0]), 0.08, 12)
BIM = MethodCurve(THRESHOLDS, torch.tensor([0.0, 0.5, 0.75]), 0.0342, 80, published=True)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """The lines, legend and title of each figure when it was saved."""
    monkeypatch.setattr(charts, "DPI", 60)
    seen: list[dict] = []
    save = matplotlib.figure.Figure.savefig

    def spy(figure, file, **options):
        (ax,) = figure.axes
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        lines = [(line.get_xdata().tolist(), line.get_ydata().tolist(), line.get_linestyle()) for line in ax.lines]
        colors = [line.get_color() for line in ax.lines]
        seen.append(
            {"legend": legend, "lines": lines, "colors": colors, "title": ax.get_title(), "xlim": ax.get_xlim()}
        )
        return save(figure, file, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", spy)
    return seen


def test_all_files_of_the_three_figures(tmp_path: Path, drawn: list[dict]) -> None:
    curves = {name: {"ours": OURS} for name in ("orbit", "symmetry", "map")}
    files = write_report(ROWS, curves, tmp_path / "new" / "report", "Cats")
    names = [f"{n}.{kind}" for n in ("figure6_orbit", "figure8_symmetry", "figure10_map") for kind in ("png", "svg")]
    assert list(files) == ["csv", "table", *names]
    assert sorted(path.name for path in (tmp_path / "new" / "report").iterdir()) == sorted(
        ["pairs.csv", "table.md", *names]
    )
    assert files["csv"].read_text() == "method,source,target,map_mean\nours,a,b,0.1\n"
    assert files["table"].read_text(encoding="utf-8").startswith("# Cats\n")
    with Image.open(files["figure10_map.png"]) as image:
        image.load()
    assert ElementTree.parse(files["figure8_symmetry.svg"]).getroot().tag.endswith("svg")


def test_a_figure_has_the_curves_with_their_means_and_published_ones_dashed(tmp_path: Path, drawn: list[dict]) -> None:
    write_report(ROWS, {"map": {"ours": OURS, "BIM": BIM}}, tmp_path)
    png, svg = drawn
    assert png == svg
    assert png["legend"] == ["ours (mean 0.0800, 12)", "BIM (mean 0.0342, 80)"]
    assert png["lines"] == [
        (THRESHOLDS.tolist(), OURS.shares.tolist(), "-"),
        (THRESHOLDS.tolist(), BIM.shares.tolist(), "--"),
    ]
    assert "Figure 10" in png["title"]
    assert png["xlim"] == pytest.approx((0, 0.2))


def test_fifteen_methods_are_told_apart(tmp_path: Path, drawn: list[dict]) -> None:
    curves = {f"method {i}": BIM if i % 3 == 0 else OURS for i in range(14)}
    write_report(ROWS, {"mine": curves}, tmp_path)
    looks = {(color, line[2]) for color, line in zip(drawn[0]["colors"], drawn[0]["lines"], strict=True)}
    assert len(looks) == 14
    assert {path.name for path in tmp_path.iterdir()} == {"pairs.csv", "table.md", "mine.png", "mine.svg"}


def test_a_report_is_written_over_the_old_one_whole_or_not_at_all(
    tmp_path: Path, drawn: list[dict], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_report(ROWS, {"map": {"ours": OURS}}, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def broken(figure, file, **options):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", broken)
    with pytest.raises(OSError, match="disk full"):
        write_report([{**ROWS[0], "map_mean": 0.2}], {"map": {"ours": OURS}}, tmp_path)
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(after) == set(before)
    assert after["figure10_map.png"] == before["figure10_map.png"]
    assert after["pairs.csv"] != before["pairs.csv"]


def test_bad_input_writes_nothing(tmp_path: Path) -> None:
    for rows, curves, message in (
        ([], {}, "one row or more"),
        (ROWS, {"map": {}}, r"curves\['map'\]: expected one curve or more"),
    ):
        with pytest.raises(ValueError, match=message):
            write_report(rows, curves, tmp_path / "out")
        assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="shares: expected one for each of 3 thresholds"):
        MethodCurve(THRESHOLDS, torch.zeros(2), 0.0, 1)


def test_curves_of_reports_count_every_pair_once() -> None:
    reports = [make_report("map", torch.tensor(e, dtype=torch.float64)) for e in ([0.0, 0.0, 0.3], [0.1])]
    curve = MethodCurve.from_reports(reports, torch.tensor([0.0, 0.1, 0.3]))
    assert curve.shares.tolist() == pytest.approx([1 / 3, 5 / 6, 1.0])
    assert (curve.mean, curve.n_pairs, curve.published) == (pytest.approx(0.1), 2, False)
    with pytest.raises(ValueError, match="one or more curves"):
        MethodCurve.from_reports([])
