"""A plain folder of meshes and its list of pairs."""

import pytest
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes


def test_meshes_of_any_kind_without_a_list(tmp_path):
    write_mesh(tmp_path / "cat1.off")
    write_mesh(tmp_path / "cat2.ply")
    write_mesh(tmp_path / "dog.obj", 7)
    shapes = open_shapes(tmp_path)
    assert shapes.names == ["cat1", "cat2", "dog"]
    assert shapes.classes == ["cat", "dog"]
    assert shapes.published_pairs() == []
    assert "no list of pairs" in shapes.recognised[0]
    same = shapes.truth("cat1", "cat2")
    assert same.points.tolist() == list(range(6))
    assert same.source == "the same triangles: vertex ids agree"
    with pytest.raises(TruthError, match="their triangles differ, and no list of pairs names a file"):
        shapes.truth("cat1", "dog")
    assert shapes.truth("dog", "dog").points.tolist() == list(range(7))
    assert found(shapes) == {}


@pytest.mark.parametrize("base", [0, 1])
def test_truth_from_the_files_that_the_list_names(tmp_path, base):
    for name, count in (("a", 6), ("b", 7), ("c", 6)):
        write_mesh(tmp_path / f"{name}.off", count)
    write_lines(tmp_path / "pairs.txt", ["a.off b.off truth/ab.txt", "a c", "b c truth/bc.txt"])
    write_lines(tmp_path / "truth/ab.txt", [i + base for i in (6, 5, 4, 3, 2, 0)])
    write_lines(tmp_path / "truth/bc.txt", [(i + base, j + base) for i, j in ((6, 5), (1, 0))])
    shapes = open_shapes(tmp_path)
    assert shapes.published_pairs() == [("a", "b"), ("a", "c"), ("b", "c")]
    assert any(f"{base}-based" in sentence for sentence in shapes.recognised) or base == 0
    assert shapes.truth("a", "b").points.tolist() == [6, 5, 4, 3, 2, 0]
    assert shapes.truth("b", "a").at.tolist() == [6, 5, 4, 3, 2, 0]
    marks = shapes.truth("b", "c")
    assert (marks.at.tolist(), marks.points.tolist()) == ([6, 1], [5, 0])
    assert "vertex ids agree" in shapes.truth("a", "c").source
    assert found(shapes) == {}


@pytest.mark.parametrize(
    ("lines", "severity", "message"),
    [
        (["a b", "a z"], "missing", r"pairs\.txt:2: there is no shape 'z'"),
        (["a"], "malformed", r"pairs\.txt:1: expected two names"),
        (["a b no.txt"], "missing", r"no\.txt: cannot be read"),
        (["a b short.txt"], "malformed", r"short\.txt: 2 lines, but a has 6 vertices"),
        (["a b far.txt"], "malformed", r"far\.txt:1: vertex 9 is out of range: b has 6"),
        (["a b words.txt"], "malformed", r"words\.txt:1: expected one number"),
    ],
)
def test_faults_of_the_list_are_named(tmp_path, lines, severity, message):
    for name in ("a", "b"):
        write_mesh(tmp_path / f"{name}.off")
    write_lines(tmp_path / "short.txt", [0, 1])
    write_lines(tmp_path / "far.txt", [9, 0, 1, 2, 3, 4])
    write_lines(tmp_path / "words.txt", ["x"])
    write_lines(tmp_path / "pairs.txt", lines)
    shapes = open_shapes(tmp_path)
    (said,) = found(shapes, severity).values()
    with pytest.raises(ValueError, match=message):
        raise ValueError(said)
    if len(lines[0].split()) < 3:
        with pytest.raises(ValueError, match=message):
            shapes.published_pairs()
    else:
        with pytest.raises(TruthError, match=message):
            shapes.truth("a", "b")


def test_a_heading_of_the_list_is_none_of_its_pairs(tmp_path):
    for name in ("a", "b"):
        write_mesh(tmp_path / f"{name}.off")
    write_lines(tmp_path / "pairs.csv", ["source,target", "a,b"])
    shapes = open_shapes(tmp_path)
    assert shapes.published_pairs() == [("a", "b")]
    assert found(shapes) == {}


def test_both_columns_of_the_truth_say_from_what_number_ids_count(tmp_path):
    """Few landmarks: the largest id of the second shape is not among them, that of the first is."""
    for name in ("a", "b"):
        write_mesh(tmp_path / f"{name}.off")
    write_lines(tmp_path / "pairs.txt", ["a b marks.txt"])
    write_lines(tmp_path / "marks.txt", [(6, 3), (1, 2)])
    truth = open_shapes(tmp_path).truth("a", "b")
    assert (truth.at.tolist(), truth.points.tolist()) == ([5, 0], [2, 1])
