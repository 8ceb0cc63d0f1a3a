"""From results to rows and curves."""

import pytest
import torch

from torchqm.benchmark.summary import make_curves, make_rows, read_published_rows

BLOCK = "{}:\n\tAverage\t[{}]\n{}\tPerSampleErrors\t[{}]\n"


def record(source, target, kind="pair", status="done", method="m", **more):
    row = {f"{name}_mean": sum(values) / len(values) for name, values in more.items()}
    head = {"method": method, "source": source, "target": target, "kind": kind, "status": status}
    return head | {"row": row, "errors": more, "notes": []}


def test_a_shape_with_itself_and_its_symmetry_are_one_row():
    rows = make_rows(
        [
            record("a", "a", "symmetry", symmetry=[0.1]),
            record("a", "a", plain=[0.0]),
            record("b", "b", "symmetry", "none"),
            record("a", "b", status="failed") | {"reason": "why"},
        ]
    )
    assert [(row["source"], row["target"]) for row in rows] == [("a", "a"), ("a", "b")]
    assert (rows[0]["plain_mean"], rows[0]["symmetry_mean"]) == (0.0, 0.1)
    assert rows[1]["reason"] == "why"


def test_an_infinite_mean_stays_in_the_table():
    far = record("a", "c", plain=[0.1]) | {"row": {"plain_mean": None, "plain_median": 0.1}}
    rows = make_rows([record("a", "b", plain=[0.0]), far])
    assert [row["plain_mean"] for row in rows] == [0.0, float("inf")]


def test_curves_are_means_over_pairs_and_infinity_stays_one():
    curves = make_curves([record("a", "b", plain=[0.0, 0.0]), record("b", "a", plain=[0.2, 9.0])])
    assert curves["plain"]["m"].n_pairs == 2
    far = record("a", "b", plain=[0.0])
    far["errors"] = {"plain": [0.0, None]}
    (curve,) = make_curves([far])["plain"].values()
    assert float(curve.shares[-1]) == 0.5
    assert curve.mean == float("inf")


def test_published_rows(tmp_path):
    text = BLOCK.format("Stats", 0.2, "\tTime\t[9]\n", "0.1, 0.3")
    text += BLOCK.format("StatsWithFlip", 0.05, "\tFlipped\t[true]\n", "0.05")
    for pair in ("cat0_to_cat1", "cat0_to_cat2"):
        (tmp_path / f"BenchResult_BlendedMap_{pair}.txt").write_text(text)
    found = read_published_rows(tmp_path, "BlendedMap", [("cat0", "cat1"), ("cat1", "cat0")])
    (row,) = found.rows
    assert (row["method"], row["source"], row["target"]) == ("published:BlendedMap", "cat0", "cat1")
    assert (row["plain_mean"], row["map_mean"]) == (pytest.approx(0.2), pytest.approx(0.05))
    assert (row["points"], row["points_mirrored"], row["flip_map"], row["seconds"]) == (2, 1, True, 9)
    curves = make_curves([], [found])
    assert curves["plain"]["published:BlendedMap"].published
    assert list(curves["map"]) == ["published:BlendedMap, landmarks"]
    assert torch.equal(curves["map"]["published:BlendedMap, landmarks"].shares[-1:], torch.ones(1, dtype=torch.float64))
    with pytest.raises(ValueError, match="no result of it for any of the 1 pairs"):
        read_published_rows(tmp_path, "BlendedMap", [("dog0", "dog1")])
    (tmp_path / "BenchResult_BlendedMap_cat0_to_cat2.txt").write_text(text[:50])
    with pytest.raises(ValueError, match=r"cat0_to_cat2\.txt"):
        read_published_rows(tmp_path, "BlendedMap", [("cat0", "cat1")])
