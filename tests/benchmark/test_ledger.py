"""Result files: names that cannot collide, records that are taken only for what they were made from."""

import os
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchqm.benchmark.ledger import LedgerError, clean, file_name, read_record, write_record

RECORD = {"key": "k", "method": "m", "source": "a", "target": "b", "kind": "pair", "status": "done", "row": {}}
RECORD |= {"errors": {"plain": [0.0, float("inf")]}}
NAMES = st.text("ab/+%.- 0", min_size=1, max_size=4)


@given(st.lists(NAMES, min_size=1, max_size=2), st.lists(NAMES, min_size=1, max_size=2))
def test_different_shapes_have_different_files(first, second):
    assert (file_name(*first) == file_name(*second)) == (first == second)
    assert "/" not in file_name(*first)


def test_a_record_is_read_for_its_own_key_only(tmp_path):
    path = tmp_path / "method" / "a+b.json"
    assert read_record(path, "k") is None
    write_record(path, RECORD)
    found = read_record(path, "k")
    assert {name: found[name] for name in ("source", "target", "status")} == {
        "source": "a",
        "target": "b",
        "status": "done",
    }
    assert found["errors"] == {"plain": [0.0, None]}  # JSON has no infinity
    assert read_record(path, "other") is None


def test_a_file_cut_short_is_named_with_its_line(tmp_path):
    path = tmp_path / "a+b.json"
    write_record(path, RECORD)
    path.write_text("\n".join(path.read_text().splitlines()[:4]))
    with pytest.raises(LedgerError, match=r"a\+b\.json:4: damaged or cut short"):
        read_record(path, "k")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(LedgerError, match="cannot be read"):
        read_record(path, "k")
    path.write_text("[]")
    with pytest.raises(LedgerError, match="no result of a pair"):
        read_record(path, "k")


def test_clean_removes_half_files_and_nothing_else(tmp_path):
    write_record(tmp_path / "results" / "m" / "a+b.json", RECORD)
    half = tmp_path / "results" / "m" / ".a+c.json.xyz.part"
    half.write_text("{")
    clean(tmp_path)
    assert [p.name for p in (tmp_path / "results" / "m").iterdir()] == ["a+b.json"]


def test_clean_leaves_young_halves_to_those_who_may_still_write_them(tmp_path):
    old, young = (tmp_path / "results" / "m" / f".{name}.json.xyz.part" for name in ("old", "young"))
    old.parent.mkdir(parents=True)
    for path, age in ((old, 4000), (young, 100)):
        path.write_text("{")
        os.utime(path, (time.time() - age,) * 2)
    clean(tmp_path, 3600.0)
    assert [p.name for p in old.parent.iterdir()] == [young.name]
