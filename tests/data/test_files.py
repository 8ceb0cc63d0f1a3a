"""Readers of small files: ids and their base, barycentric points, pairs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from references.folders import write_lines

from torchqm.data.files import (
    read_barycentric,
    read_ids,
    read_names,
    read_pairs,
    read_table,
    recognise_base,
)


@given(st.integers(1, 50), st.lists(st.sets(st.integers(0, 49), min_size=1), min_size=1, max_size=4), st.integers(0, 1))
def test_a_base_is_recognised_wherever_an_end_of_the_range_occurs(count, drawn, base):
    files = [np.array(sorted(i % count for i in ids)) for ids in drawn]
    told = any((0 if base == 0 else count - 1) in ids for ids in files)
    found = recognise_base("x", [(ids + base, count) for ids in files], default=1 - base)
    if told:
        assert found.base == base
        assert f"{base}-based" in found.why
    else:
        assert found.base == 1 - base
        assert "by custom" in found.why


def test_most_files_decide_and_the_others_are_counted():
    found = recognise_base("x", [(np.array([1, 5]), 5), (np.array([2, 5]), 5), (np.array([0, 1]), 5)], 0)
    assert found.base == 1
    assert "2 of 3 files have an id equal to the count, 1 an id 0" in found.why
    both = [(np.array([0, 5]), 5)] * 3  # contradict themselves, whatever the base
    assert recognise_base("x", [*both, (np.array([0, 3]), 5)], 1).base == 0
    nobody = recognise_base("x", [(np.array([2, 3]), 5)], 1)
    assert "no file has an id 0, or one equal to the count" in nobody.why
    tie = recognise_base("x", [(np.array([0, 4]), 5), (np.array([1, 5]), 5)], 1)
    assert tie.base == 1
    assert "as many files say 0 as say 1" in tie.why


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=30), st.sampled_from(["\n", "\r\n", "\n\n"]))
def test_ids_are_read_as_written(tmp_path_factory, ids, end):
    path = tmp_path_factory.mktemp("ids") / "x.vts"
    path.write_bytes(end.join(map(str, ids)).encode())
    assert read_ids(path).values.tolist() == ids


def test_only_the_asked_column_is_taken(tmp_path):
    write_lines(tmp_path / "x.vts", [(4, 0, 0, 0), (1, 0, 0, 0)])
    assert read_ids(tmp_path / "x.vts").values.tolist() == [4, 1]
    write_lines(tmp_path / "y.csv", ["4,7", "# a comment", "1, 8"])
    assert read_ids(tmp_path / "y.csv", 1).values.tolist() == [7, 8]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"x\.vts: the file is empty"),
        ("3\n\nfour\n", r"x\.vts:3: expected one number, got 'four'"),
        ("3\n4 5\n", r"x\.vts:2: expected one number, got '4 5'"),
        ("1 2\n3\n4 5 6\n", r"x\.vts:2: expected 2 numbers, got '3'"),
        ("3\n4.5\n", r"x\.vts:2: expected a whole number, got 4\.5"),
        ("3\nnan\n", r"x\.vts:2: expected a whole number, got nan"),
        ("3\0", r"x\.vts: not a text file"),
    ],
)
def test_malformed_ids_are_named_with_their_line(tmp_path, text, message):
    (tmp_path / "x.vts").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_ids(tmp_path / "x.vts")


def test_ids_out_of_range_are_named_with_their_line(tmp_path):
    write_lines(tmp_path / "x.vts", ["# header", 1, 6, 7])
    ids = read_ids(tmp_path / "x.vts")
    assert ids.checked(1, 7, "x").tolist() == [0, 5, 6]
    message = r"x\.vts:4: vertex 7 is out of range: x has 6, 1 to 6 counted from 1 \(1 of 3 lines are\)"
    with pytest.raises(ValueError, match=message):
        ids.checked(1, 6, "x")
    with pytest.raises(ValueError, match=r"y\.vts: cannot be read"):
        read_ids(tmp_path / "y.vts")


def test_barycentric_points(tmp_path):
    write_lines(tmp_path / "x.baryc_gt", [(1, 0.2, 0.3, 0.5), (4, 1.0, 0.0, 0.0), (2, 0.5004, 0.5, -1e-4)])
    faces, weights = read_barycentric(tmp_path / "x.baryc_gt")
    assert faces.values.tolist() == [1, 4, 2]
    np.testing.assert_allclose(weights[:2], [[0.2, 0.3, 0.5], [1, 0, 0]])
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-15)
    assert weights.min() == 0


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((3, 0.5, 0.4, 0.2), r":2: expected three weights >= 0 that sum to 1, got 0\.5, 0\.4, 0\.2"),
        ((3, 1.5, -0.5, 0.0), r":2: expected three weights >= 0"),
        ((3, 0.5, 0.5), r":2: expected 4 numbers"),
        ((3.5, 0.5, 0.5, 0), r":2: expected a whole number, got 3\.5"),
    ],
)
def test_malformed_barycentric_points_are_named(tmp_path, row, message):
    write_lines(tmp_path / "x.baryc_gt", [(1, 0, 0, 1), row])
    with pytest.raises(ValueError, match=message):
        read_barycentric(tmp_path / "x.baryc_gt")


def test_tables_of_another_width_are_refused(tmp_path):
    write_lines(tmp_path / "x", [(1, 2, 3)])
    with pytest.raises(ValueError, match=r"x:1: expected 1 or 2 numbers in a line, got '1 2 3'"):
        read_table(tmp_path / "x", (1, 2))


def test_pairs_and_names(tmp_path):
    write_lines(tmp_path / "pairs.txt", ["# first second", "cat0.off, cat1", "", "cat1 cat2 truth/1_2.txt"])
    pairs = read_pairs(tmp_path / "pairs.txt")
    assert [(p.line, p.first, p.second, p.extra) for p in pairs] == [
        (2, "cat0", "cat1", None),
        (4, "cat1", "cat2", "truth/1_2.txt"),
    ]
    write_lines(tmp_path / "pairs.txt", ["cat0 cat1", "cat0"])
    with pytest.raises(ValueError, match=r"pairs\.txt:2: expected two names"):
        read_pairs(tmp_path / "pairs.txt")
    write_lines(tmp_path / "train.txt", ["crypto/Pose1.5", "drake/b.off"])
    assert read_names(tmp_path / "train.txt") == [(1, "crypto/Pose1.5"), (2, "drake/b")]
