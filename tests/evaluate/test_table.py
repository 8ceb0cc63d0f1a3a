"""The table and the CSV of a comparison, read line by line."""

import csv
import io

import pytest
import torch

from torchqm.evaluate.protocol import make_report
from torchqm.evaluate.table import checked_rows, csv_text, markdown_table


def row(method: str, source: str, target: str, **more: object) -> dict[str, object]:
    return {"method": method, "source": source, "target": target, **more}


ERRORS = torch.tensor([0.3, 0.0, 0.1, 0.05], dtype=torch.float64)
ROWS = [
    row("ours", "cat0", "cat1", plain_mean=0.01, map_mean=0.01, flip_map=False, seconds=3.0, solver="heat"),
    row("ours", "cat0", "cat2", plain_mean=0.05, map_mean=0.02, flip_map=True, seconds=5.0, solver="fast_marching"),
    row("ours", "cat0", "wolf0", reason="mesh.off:12: no | face"),
    row("BIM", "cat0", "cat1", plain_mean=0.03, seconds=None),
    row("BIM", "cat0", "cat3", plain_mean=0.5),
    row("broken", "cat0", "cat1", reason="out of\nmemory"),
]


def cells(text: str) -> list[dict[str, str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    head, _, *body = ([cell.strip() for cell in line.replace("\\|", "/")[1:-1].split("|")] for line in lines)
    assert {len(line) for line in body} == {len(head)}
    return [dict(zip(head, line, strict=True)) for line in body]


def test_one_line_for_each_protocol_and_method() -> None:
    lines = cells(markdown_table(ROWS, "Cats"))
    assert [(line["protocol"], line["method"], line["pairs"], line["failed"]) for line in lines] == [
        ("plain", "ours", "2", "1"),
        ("plain", "BIM", "2", "0"),
        ("map", "ours", "2", "1"),
        ("", "broken", "0", "1"),
    ]


def test_means_stand_beside_those_over_common_pairs() -> None:
    ours, bim, whole, _ = cells(markdown_table(ROWS))
    assert (ours["mean"], bim["mean"]) == ("0.0300", "0.2650")
    assert (ours["common"], bim["common"]) == ("0.0100 (1)", "0.0300 (1)")  # cat0 -> cat1
    assert whole["common"] == "0.0150 (2)"  # alone, all of its pairs are common
    assert ours["worst pair"] == "0.0500 cat0 → cat2"


def test_flips_seconds_and_solvers() -> None:
    ours, bim, *_ = cells(markdown_table(ROWS))
    assert (ours["flipped maps"], ours["flipped points"]) == ("0.500", "")
    assert (ours["seconds"], bim["seconds"]) == ("4.0", "")
    assert (ours["solver"], bim["solver"]) == ("fast_marching, heat", "")


def test_failures_are_listed_with_their_reasons_in_one_line_each() -> None:
    text = markdown_table(ROWS, "Cats")
    assert text.startswith("# Cats\n")
    assert "2 failed:\n\n* ours, cat0 → wolf0: mesh.off:12: no \\| face\n* broken, cat0 → cat1: out of memory\n" in text
    assert "failed:" not in markdown_table(ROWS[:2])


def test_numbers_of_reports_find_their_columns() -> None:
    reports = [make_report(name, ERRORS) for name in ("plain", "orbit")]
    line = cells(markdown_table([row("ours", "a", "b", **reports[0].to_row(), **reports[1].to_row())]))[1]
    assert line["protocol"] == "orbit"
    assert (line["mean"], line["median"], line["AUC"]) == ("0.1125", "0.0500", "0.600")
    assert (line["≤ 0.05"], line["≤ 0.1"], line["≤ 0.25"]) == ("0.500", "0.750", "0.750")


def test_infinite_means_are_shown_and_own_protocols_come_last() -> None:
    lines = cells(markdown_table([row("ours", "a", "b", mine_mean=0.1, plain_mean=float("inf"))]))
    assert [(line["protocol"], line["mean"]) for line in lines] == [("plain", "inf"), ("mine", "0.1000")]


def test_csv_keeps_everything_in_the_order_it_came() -> None:
    rows = [row("ours, new", "a", "b", flip_map=True, note={"k": [1]}), row("old", "a", "b", reason='say "no"', x=0.1)]
    text = csv_text(rows)
    assert text.splitlines()[0] == "method,source,target,flip_map,note,reason,x"
    new, old = csv.DictReader(io.StringIO(text))
    assert (new["method"], new["flip_map"], new["note"], new["reason"]) == ("ours, new", "true", '{"k": [1]}', "")
    assert (old["flip_map"], old["reason"], float(old["x"])) == ("", 'say "no"', 0.1)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "one row or more"),
        ([row("a", "x", "y"), {"method": "a", "source": "x"}], r"rows\[1\]: expected a name under 'target', got None"),
        ([row("", "x", "y")], r"rows\[0\]: expected a name under 'method', got ''"),
        ([row("a", "x", "y"), row("a", "x", "y")], r"rows\[1\]: a second row of a for x -> y"),
    ],
)
def test_bad_rows_are_named(rows: list[dict[str, object]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        checked_rows(rows)
