from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from references.sets import Named

from torchqm.data.pairs import choose_pairs

SHAPES = Named(["cat0", "cat1", "cat10", "dog0", "dog1"], published=[("cat0", "cat10")])


def written(folder: Path, text: str) -> Path:
    path = folder / "pairs.txt"
    path.write_text(text)
    return path


@given(st.lists(st.integers(1, 4), min_size=1, max_size=4))
def test_counts_and_laws(sizes):
    """n shapes have n (n - 1) ordered pairs; a pair of unordered ones has its mirror image in all."""
    names = [f"{chr(97 + c)}{i}" for c, size in enumerate(sizes) for i in range(size)]
    shapes, n = Named(names), len(names)
    everything = [(a, b) for a in names for b in names]
    assert choose_pairs(shapes, "all+self") == everything
    if n > 1:
        ordered, once = choose_pairs(shapes, "all"), choose_pairs(shapes, "unordered")
        assert ordered == [(a, b) for a, b in everything if a != b]
        assert sorted(once + [(b, a) for a, b in once]) == sorted(ordered)
        assert all(names.index(a) < names.index(b) for a, b in once)
    inside = choose_pairs(shapes, "within-class+self")
    assert len(inside) == sum(size * size for size in sizes)
    assert inside == [(a, b) for a, b in everything if a[0] == b[0]]
    if max(sizes) > 1:
        once = choose_pairs(shapes, "within-class+unordered")
        assert len(once) == sum(size * (size - 1) // 2 for size in sizes)


def test_published_pairs_come_as_the_set_has_them():
    assert choose_pairs(SHAPES, "published") == choose_pairs(SHAPES, "scb") == [("cat0", "cat10")]
    with pytest.raises(ValueError, match=r"pairs 'scb': no pair in nowhere \(plain, 1 shapes\)"):
        choose_pairs(Named(["cat0"]), "scb")


def test_a_file_keeps_its_order(tmp_path):
    text = "source,target\n# made by hand\ndog0, cat1\n\ncat1\tdog0  # the other way\ncat10.off cat0.OFF\n"
    path = written(tmp_path, text)
    expected = [("dog0", "cat1"), ("cat1", "dog0"), ("cat10", "cat0")]
    assert choose_pairs(SHAPES, path) == choose_pairs(SHAPES, str(path)) == expected


def test_a_heading_that_is_a_shape_is_a_pair(tmp_path):
    assert choose_pairs(Named(["first", "second"]), written(tmp_path, "first second\n")) == [("first", "second")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cat0 cat1\n\ncat0 cat2\n", r"pairs.txt:3: there is no shape 'cat2' in nowhere; the nearest names are cat"),
        ("zebra cat1\n", r"pairs.txt:1: there is no shape 'zebra' in nowhere; names are like cat0, cat1, cat10"),
        ("cat0 cat1\ncat1\n", r"pairs.txt:2: expected two names"),
        ("cat0 cat1\n# \ncat0,cat1\n", r"pairs.txt:3: cat0 cat1 stands in line 1 already"),
        ("# nothing\n", r"pairs.txt: no pair in nowhere"),
    ],
)
def test_a_bad_file_is_named_with_its_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        choose_pairs(SHAPES, written(tmp_path, text))


def test_a_shape_that_is_left_out_is_named_with_the_reason(tmp_path):
    shapes = Named(["cat0", "cat1"])
    shapes.excluded = {"cat11": "5 vertices where class 'cat' has 6"}
    with pytest.raises(ValueError, match=r"pairs.txt:1: 'cat11' is no usable shape of nowhere: 5 vertices where"):
        choose_pairs(shapes, written(tmp_path, "cat0 cat11\n"))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("every", r"pairs 'every': no such file, and no known word; allowed are all \(ordered pairs\)"),
        ("all+unordered", "allowed are all"),
        ("self", "allowed are all"),
        ("all+all", "allowed are all"),
        ("scb+self", "go with no other word"),
    ],
)
def test_an_unknown_word_is_answered_with_the_known_ones(spec, message):
    with pytest.raises(ValueError, match=message):
        choose_pairs(SHAPES, spec)
