import json

import numpy as np
import pytest

from torchqm.cli.main import main


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """One run on small creatures: the folder it wrote, and what it printed."""
    out = tmp_path_factory.mktemp("demo") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchqm.viz.charts.DPI", 40)
        patch.setattr("torchqm.viz.render.REFINE_BELOW", 0)
        patch.setattr("builtins.print", lambda *words, **_: printed.append(" ".join(map(str, words))))
        printed = []
        assert main(["demo", "--n-verts", "1000", "--out", str(out)]) == 0
    return out, "\n".join(printed)


def test_demo_writes_three_files(demo):
    out, _ = demo
    assert {p.name for p in out.iterdir()} == {"match.npz", "match.png", "summary.json"}
    with np.load(out / "match.npz", allow_pickle=False) as saved:
        assert saved["labels"].tolist() == ["direct", "mirrored"]
        assert saved["maps"].shape[0] == 2


def test_demo_finds_the_exact_maps(demo):
    summary = json.loads((demo[0] / "summary.json").read_text())
    rows = summary["errors"]["maps"]
    assert [row["truth"] for row in rows] == ["direct", "mirrored"]
    for row in rows:
        assert row["mean"] < 0.02  # vertices are 0.03 apart
        assert row["share_below_0.05"] > 0.9
    assert summary["errors"]["points"] == 100


def test_demo_prints_a_row_a_map_and_the_seconds(demo):
    out, printed = demo
    error = json.loads((out / "summary.json").read_text())["errors"]["maps"][0]["mean"]
    row = next(line for line in printed.splitlines() if line.startswith("0 direct"))
    assert f"{error:.4f}" in row
    assert "building the creatures" in printed
    assert "quotient matching" in printed


@pytest.mark.parametrize("options", [["--n-verts", "100"], ["--seed", "-1"]])
def test_demo_refuses_what_cannot_be_built(tmp_path, capsys, options):
    assert main(["demo", *options, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
