import csv

from torchqm.cli.sweep_results import write_tables


def row_of(k, seed, error=None, status="done"):
    found = {} if error is None else {"test_orbit_error": error}
    return {"run": f"k={k}-seed={seed}", "model.k": k, "seed": seed, "status": status, "seconds": 2.0} | found


def test_a_run_that_failed_is_in_both_tables_and_in_no_mean(tmp_path):
    rows = [row_of(10, 0, 0.5), row_of(20, 0, status="failed: the loss is nan at the pairs a -> b"), row_of(10, 1, 1.5)]
    rows.append(row_of(20, 1, 1.5))
    text = write_tables(rows, ["model.k"], tmp_path)
    assert text.splitlines() == [
        "| model.k | seeds | seconds | test_orbit_error |",
        "| --- | --- | --- | --- |",
        "| 10 | 2 | 2 ± 0 | 1 ± 0.71 |",
        "| 20 | 1 of 2 | 2 | 1.5 |",
        "",
        "- k=20-seed=0: failed: the loss is nan at the pairs a -> b",
    ]
    assert (tmp_path / "sweep.md").read_text() == text
    with (tmp_path / "sweep.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [(row["run"], row["seed"], row["test_orbit_error"]) for row in table] == [
        ("k=10-seed=0", "0", "0.5"), ("k=20-seed=0", "0", ""), ("k=10-seed=1", "1", "1.5"), ("k=20-seed=1", "1", "1.5")
    ]  # fmt: skip
