"""run.json: all runs that wrote results into a folder, also those that were killed and those of older files."""

import json

import pytest

from torchqm.benchmark.runs import begin_run, end_run, write_report


def read(out):
    return json.loads((out / "run.json").read_text())


def test_runs_are_added_and_reports_are_not_runs(tmp_path):
    begin_run(tmp_path, {"jobs": 1}, {"name": "local"})
    assert read(tmp_path)["runs"][0]["results"] is None
    end_run(tmp_path, 7, {"name": "local", "workers": 2})
    begin_run(tmp_path, {"jobs": 2}, {"name": "dask"})
    write_report(tmp_path, {"jobs": 3})
    found = read(tmp_path)
    first, second = found["runs"]
    assert (first["results"], first["arguments"], first["backend"]) == (7, {"jobs": 1}, {"name": "local", "workers": 2})
    assert (second["results"], second["arguments"], second["backend"]) == (None, {"jobs": 2}, {"name": "dask"})
    assert found["arguments"] == {"jobs": 3}
    assert first["begun"] <= second["begun"]
    assert {"torchqm", "torch"} <= set(first["versions"])


def test_a_file_of_one_run_becomes_the_first_of_several(tmp_path):
    old = {"arguments": {"jobs": 2}, "backend": {"name": "local"}, "versions": {"torchqm": "0.0.1"}, "machine": {}}
    (tmp_path / "run.json").write_text(json.dumps(old))
    begin_run(tmp_path, {}, {})
    assert read(tmp_path)["runs"][0] == {"results": None, **old}
    assert len(read(tmp_path)["runs"]) == 2


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"runs": 3}', '{"runs": ["x"]}'])
def test_a_damaged_file_stops_nothing(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    begin_run(tmp_path, {"a": 1}, {})
    assert [run["arguments"] for run in read(tmp_path)["runs"]] == [{"a": 1}]
