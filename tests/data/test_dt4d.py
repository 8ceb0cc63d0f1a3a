"""DT4D: truth inside a character and between two."""

import pytest
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes


@pytest.fixture
def root(tmp_path):
    """Templates of 3 (crypto), 2 (big_boy) and 4 points (drake); crypto's points are big_boy's 2, 1, 1."""
    for name, ids in (
        ("crypto/a", [1, 2, 3]),
        ("crypto/b", [4, 5, 6]),
        ("big_boy/a", [6, 1]),
        ("drake/a", [1, 2, 3, 4]),
        ("pumpkinhulk/a", [1]),
    ):
        write_mesh(tmp_path / f"off/{name}.off")
        write_lines(tmp_path / f"corres/{name}.vts", ids)
    write_lines(tmp_path / "corres/cross_category_corres/crypto_big_boy.vts", [2, 1, 1])
    write_lines(tmp_path / "train.txt", ["crypto/b", "big_boy/a", "pumpkinhulk/a"])
    write_lines(tmp_path / "test.txt", ["crypto/a"])
    return tmp_path


def test_characters_and_parts(root):
    shapes = open_shapes(root)
    assert shapes.layout == "dt4d"
    assert shapes.names == ["big_boy/a", "crypto/a", "crypto/b", "drake/a"]
    assert shapes.classes == ["big_boy", "crypto", "drake"]
    assert shapes.split() == {"train": ["crypto/b", "big_boy/a"], "test": ["crypto/a"]}
    assert "pumpkinhulk is left out, as everyone does" in shapes.recognised
    assert found(shapes) == {}


def test_mirror_images_inside_and_between_characters(root):
    """Between two the reflection is that of the second, at the points that the truth goes to, whatever their order."""
    write_lines(root / "corres/big_boy/a.sym.vts", [1, 6])  # its two points change places
    shapes = open_shapes(root)
    inside = shapes.mirrored_truth("big_boy/a", "big_boy/a")
    assert (inside.at.tolist(), inside.points.tolist()) == ([5, 0], [0, 5])
    between = shapes.mirrored_truth("crypto/b", "big_boy/a")
    assert dict(zip(between.at.tolist(), between.points.tolist(), strict=True)) == {3: 5, 4: 0, 5: 0}


def test_truth_inside_and_between_characters(root):
    shapes = open_shapes(root)
    inside = shapes.truth("crypto/a", "crypto/b")
    assert (inside.at.tolist(), inside.points.tolist()) == ([0, 1, 2], [3, 4, 5])
    between = shapes.truth("crypto/b", "big_boy/a")
    assert (between.at.tolist(), between.points.tolist()) == ([3, 4, 5], [0, 5, 5])
    back = shapes.truth("big_boy/a", "crypto/b")
    assert (back.at.tolist(), back.points.tolist()) == ([0, 5, 5], [3, 4, 5])
    assert "through crypto_big_boy.vts" in back.source
    with pytest.raises(TruthError, match=r"there is no cross_category_corres/crypto_drake\.vts"):
        shapes.truth("crypto/a", "drake/a")


def test_equal_counts_make_no_common_template(root):
    write_lines(root / "corres/drake/a.vts", [1, 2, 3])
    write_lines(root / "corres/big_boy/a.vts", [6, 1, 2])
    shapes = open_shapes(root)
    with pytest.raises(TruthError, match="no truth from crypto/a to drake/a"):
        shapes.truth("crypto/a", "drake/a")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([2, 1], r"crypto_big_boy\.vts: 2 lines, but the template of crypto has 3 points"),
        ([2, 1, 3], r"crypto_big_boy\.vts:3: point 3 is out of range: the template of big_boy has 2"),
        ([2, 1, "?"], r"crypto_big_boy\.vts:3: expected one number"),
    ],
)
def test_malformed_files_between_characters_are_named(root, lines, message):
    write_lines(root / "corres/cross_category_corres/crypto_big_boy.vts", lines)
    shapes = open_shapes(root)
    with pytest.raises(TruthError, match=message):
        shapes.truth("crypto/a", "big_boy/a")
    assert list(found(shapes, "malformed")) == ["crypto_big_boy.vts"]


def test_missing_files_are_named(root):
    (root / "corres/drake/a.vts").unlink()
    (root / "off/crypto/b.off").unlink()
    missing = found(open_shapes(root), "missing")
    assert set(missing) == {"drake/a", "crypto/b"}
    assert "drake/a.vts: no such file" in missing["drake/a"]


def test_lists_and_maps_between_characters_may_be_absent(root):
    for name in ("train.txt", "test.txt", "corres/cross_category_corres/crypto_big_boy.vts"):
        (root / name).unlink()
    shapes = open_shapes(root)
    assert shapes.split() is None
    assert any("truth inside a character only" in sentence for sentence in shapes.recognised)
