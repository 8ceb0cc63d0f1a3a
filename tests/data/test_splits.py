import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from references.sets import Named

from torchqm.data.splits import PARTS, Split, SplitError, draw_split, own_split, read_split_file, write_split_file


def sized(sizes, parts=None):
    """Shapes ``class-number``, as many of each class as given."""
    return Named([f"{cls}-{i}" for cls, size in sizes.items() for i in range(size)], parts=parts)


@st.composite
def some_shares(draw):
    cuts = sorted([draw(st.integers(0, 20)), draw(st.integers(0, 20))])
    return cuts[0] / 20, (cuts[1] - cuts[0]) / 20, (20 - cuts[1]) / 20


@given(st.lists(st.integers(1, 23), min_size=1, max_size=4), some_shares(), st.integers(0, 9))
def test_each_class_is_divided_by_the_shares_and_nothing_is_lost(sizes, shares, seed):
    shapes = sized({f"class-{chr(97 + i)}": size for i, size in enumerate(sizes)})
    split = draw_split(shapes, shares, seed)
    assert sorted(split.train + split.validation + split.test) == sorted(shapes.names)
    for part, share in zip(PARTS, shares, strict=True):
        names = split.part(part)
        assert list(names) == [name for name in shapes.names if name in names]
        for i, size in enumerate(sizes):
            count = sum(name.startswith(f"class-{chr(97 + i)}-") for name in names)
            assert math.floor(share * size + 1e-9) <= count <= math.ceil(share * size - 1e-9)


def test_the_seed_decides_and_other_classes_do_not():
    shapes = sized({"cat": 10, "dog": 10})
    assert draw_split(shapes, seed=1) == draw_split(shapes, seed=1)
    assert draw_split(shapes, seed=1) != draw_split(shapes, seed=2)
    cats = [name for name in draw_split(shapes, seed=1).test if name.startswith("cat")]
    assert list(draw_split(sized({"cat": 10}), seed=1).test) == cats
    # equally large classes are not all drawn alike
    numbers = [{n.split("-")[1] for n in draw_split(shapes, seed=1).test if n.startswith(c)} for c in ("cat", "dog")]
    assert numbers[0] != numbers[1]


def test_whole_classes_stay_together():
    shapes = sized({"cat": 3, "dog": 5, "horse": 2, "wolf": 4})
    split = draw_split(shapes, (0.5, 0.25, 0.25), whole_classes=True)
    classes = [{shapes.shape_class(name) for name in split.part(part)} for part in PARTS]
    assert [len(c) for c in classes] == [2, 1, 1]
    assert set().union(*classes) == {"cat", "dog", "horse", "wolf"}


@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.5, 0.6, 0.1), (1.2, -0.2, 0.0), (math.nan, 0.5, 0.5)])
def test_shares_that_are_none_are_refused(shares):
    with pytest.raises(ValueError, match="shares: given"):
        draw_split(sized({"cat": 2}), shares)


def test_a_name_belongs_to_one_part():
    with pytest.raises(ValueError, match="test: 'a' stands in train and in test"):
        Split(train=("a", "b"), test=("a",))
    with pytest.raises(ValueError, match="train: 'a' stands twice in train"):
        Split(train=("a", "a"))
    with pytest.raises(ValueError, match="part is 'val'; allowed are train, validation, test"):
        Split().part("val")


def test_the_sets_own_split():
    assert own_split(sized({"cat": 3})) is None
    shapes = sized({"cat": 3}, {"train": ["cat-0", "cat-2"], "test": ["cat-1"]})
    assert own_split(shapes) == Split(train=("cat-0", "cat-2"), test=("cat-1",))


def test_an_own_split_without_a_part_is_no_split():
    """Files that name nothing that is here must not become an empty training set."""
    with pytest.raises(SplitError, match="nowhere: its own split has no train shapes"):
        own_split(Named(["a-0", "a-1"], parts={"train": [], "test": ["a-1"]}))
    with pytest.raises(SplitError, match="no train and no test shapes"):
        own_split(Named(["a-0"], parts={"train_cat": ["a-0"]}))


NAMES = st.text('aZ0.5-_: #"[]{}é,\x27&*!|>%@`', min_size=1, max_size=6).map(str.strip).filter(bool)


@given(st.lists(NAMES | st.sampled_from(["001", "1e5", "null", "yes", "~", "1:30"]), unique=True, max_size=8))
def test_what_is_written_is_read_back(tmp_path_factory, names):
    """Whatever the names look like: numbers, truth values, punctuation."""
    split = Split(tuple(names[::3]), tuple(names[1::3]), tuple(names[2::3]))
    path = tmp_path_factory.mktemp("split") / "split.yaml"
    assert write_split_file(path, split, {"layout": "scb", "seed": 3}) == path
    assert read_split_file(path) == split
    assert path.read_text("utf-8").startswith("layout: scb\nseed: 3\ntrain:")
    assert [child.name for child in path.parent.iterdir()] == ["split.yaml"]


def test_hand_written_names_are_names_even_if_they_look_like_numbers(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text("train: [001, 10]   # SHREC19\nvalidation:\ntest:\n  - no\n")
    assert read_split_file(path) == Split(train=("001", "10"), test=("no",))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("train: [a\ntest: b]\n", r"s.yaml:2: no YAML"),
        ("- a\n- b\n", r"s.yaml: expected the keys train, validation, test"),
        ("train: [cat-0]\nval: [cat-1]\n", r"s.yaml:2: unknown key 'val'; allowed are train, validation, test, layout"),
        ("train: [cat-0]\ntest:\n- cat-1\n- cat-0\n", r"s.yaml:4: 'cat-0' stands in train already \(line 1\)"),
        ("train: [cat-0]\ntrain: [cat-1]\n", r"s.yaml:2: 'train' is given twice"),
        ("seed: 0\ntrain: cat-0\n", r"s.yaml:2: train must be a list of names"),
        ("train: [[cat-0]]\n", r"s.yaml:1: train must be a list of names"),
        ("train: [cat-0,\n  cat-7]\n", r"s.yaml:2: there is no shape 'cat-7' in nowhere"),
        ("seed: 1\n", r"s.yaml: none of the keys"),
        ("", r"s.yaml: expected the keys"),
    ],
)
def test_a_bad_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(SplitError, match=message):
        read_split_file(path, sized({"cat": 2}))


def test_files_that_are_none(tmp_path):
    with pytest.raises(SplitError, match=r"none.yaml: cannot be read \(No such file"):
        read_split_file(tmp_path / "none.yaml")
    (tmp_path / "s.yaml").write_bytes(b"train: [\xff]")
    with pytest.raises(SplitError, match="byte 8 is no UTF-8"):
        read_split_file(tmp_path / "s.yaml")
    with pytest.raises(ValueError, match="notes: 'date' given"):
        write_split_file(tmp_path / "s.yaml", Split(), {"date": "today"})
