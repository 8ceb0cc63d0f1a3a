import pytest
import torch
from references.folders import write_lines, write_mesh
from references.sets import Blobs
from torch.utils.data import DataLoader

from torchqm.data.base import Truth, TruthError, TruthFileError
from torchqm.data.collate import collate
from torchqm.data.dataset import PairDataset, ShapeDataset
from torchqm.data.items import ItemOptions, make_item
from torchqm.data.layouts import open_shapes
from torchqm.evaluate.metrics import SurfacePoints

PLAIN = ItemOptions(keys=("mass",))
CORR = ItemOptions(keys=("mass", "corr"))


def test_shapes_in_order_by_number_and_by_name():
    blobs = Blobs()
    data = ShapeDataset(blobs, options=PLAIN)
    assert [item["name"] for item in data] == blobs.names
    some = ShapeDataset(blobs, ["flat-0", "two-1"], PLAIN)
    assert len(some) == 2
    assert torch.equal(some[1]["mass"], make_item(blobs, "two-1", PLAIN)["mass"])
    assert torch.equal(some.item("flat-0")["mass"], some[0]["mass"])
    with pytest.raises(IndexError):
        some[2]
    with pytest.raises(ValueError, match="no shape 'cat'"):
        ShapeDataset(blobs, ["two-0", "cat"])


@pytest.mark.parametrize(("keep", "made"), [(0, 4), (1, 3), (2, 2), (None, 2)])
def test_the_last_items_stay_in_memory(keep, made):
    blobs = Blobs()
    data = ShapeDataset(blobs, ["two-0", "two-1"], PLAIN, keep=keep)
    blobs.meshes_asked.clear()
    for index in (0, 1, 1, 0):
        data[index]
    assert len(blobs.meshes_asked) == made


def test_a_transform_gets_a_copy():
    def transform(item):
        item["mass"] = item.pop("mass") * 2
        return item

    data = ShapeDataset(Blobs(), ["two-0"], PLAIN, transform=transform)
    assert [round(float(data[0]["mass"].sum()), 6) for _ in range(3)] == [2.0] * 3


def test_a_pair_has_two_items_and_the_truth():
    blobs = Blobs()
    pair = PairDataset(blobs, [("two-0", "two-1")], options=PLAIN)[0]
    assert list(pair) == ["first", "second", "truth"]
    assert (pair["first"]["name"], pair["second"]["name"]) == ("two-0", "two-1")
    assert torch.equal(pair["truth"].points, blobs.copy.p2p_xy)


def test_rows_of_corr_correspond_in_both_directions_of_a_pair():
    data = PairDataset(Blobs(), [("two-0", "two-1"), ("two-1", "two-0")], options=CORR)
    for pair in data:
        places = [pair[side]["verts"][pair[side]["corr"]] for side in ("first", "second")]
        assert torch.allclose(*places, atol=1e-12)
    # both shapes stay in memory, and what one pair says of them does not stay with them
    assert torch.equal(data[0]["second"]["corr"], data[1]["first"]["corr"]) is False
    assert torch.equal(data[0]["first"]["corr"], torch.arange(162))


def test_points_inside_faces_become_their_nearest_corner_in_corr():
    class Inside(Blobs):
        def truth(self, first, second):
            corners = torch.tensor([[0, 1, 2], [3, 4, 5]])
            bary = torch.tensor([[0.2, 0.5, 0.3], [0.0, 0.1, 0.9]])
            return Truth(torch.tensor([7, 8]), SurfacePoints(corners, bary), "by hand")

    pair = PairDataset(Inside(), [("two-0", "two-1")], options=CORR)[0]
    assert pair["first"]["corr"].tolist() == [7, 8]
    assert pair["second"]["corr"].tolist() == [1, 5]
    assert isinstance(pair["truth"].points, SurfacePoints)


def test_what_happens_without_a_truth_is_a_choice():
    pairs = [("two-0", "two-1"), ("two-0", "eight-0")]
    required = PairDataset(Blobs(), pairs, options=CORR)
    assert required[0]["truth"] is not None
    with pytest.raises(TruthError, match="no truth from two-0 to eight-0"):
        required[1]
    optional = PairDataset(Blobs(), pairs, options=CORR, truth="optional")
    assert optional[1]["truth"] is None
    assert optional[1]["first"]["corr"].shape == optional[1]["second"]["corr"].shape == (0,)
    none = PairDataset(Blobs(), pairs, options=CORR, truth="none")
    assert list(none[1]) == ["first", "second"]
    assert torch.equal(none[1]["second"]["corr"], torch.arange(42))
    assert "corr" not in PairDataset(Blobs(), pairs, options=PLAIN, truth="none")[1]["first"]


def test_a_damaged_truth_is_no_missing_one(tmp_path):
    """Optional is a truth that there may be none of; a file that cannot be used is always told."""
    for name in ("a", "b"):
        write_mesh(tmp_path / f"off/{name}.off")
        write_lines(tmp_path / f"corres/{name}.vts", range(1, 7))
    write_lines(tmp_path / "corres/b.vts", [1, 2, 3, 99, 5, 6])
    pairs = PairDataset(open_shapes(tmp_path), [("a", "b")], options=PLAIN, truth="optional")
    with pytest.raises(TruthFileError, match=r"b\.vts.*99|99.*b\.vts"):
        pairs[0]


def test_pairs_are_chosen_by_word_and_by_the_names_of_a_part():
    blobs = Blobs()
    assert len(PairDataset(blobs, options=PLAIN)) == 12
    assert PairDataset(blobs, "within-class", options=PLAIN).pairs == [("two-0", "two-1"), ("two-1", "two-0")]
    part = PairDataset(blobs, "unordered", names=["two-1", "flat-0"], options=PLAIN)
    assert part.pairs == [("two-1", "flat-0")]
    with pytest.raises(ValueError, match="pairs: none left of within-class"):
        PairDataset(blobs, "within-class", names=["two-1", "flat-0"])
    with pytest.raises(ValueError, match="no shape 'cat'"):
        PairDataset(blobs, [("two-0", "cat")])
    with pytest.raises(ValueError, match="truth is 'maybe'; allowed are required, optional, none"):
        PairDataset(blobs, truth="maybe")


def test_a_loader_with_a_worker_gives_the_batches_of_the_dataset():
    """Sparse matrices and truths come back whole from another process."""
    options = ItemOptions(keys=("operators", "corr"), dtype=torch.float32)
    data = PairDataset(Blobs(), "all", options=options, truth="optional")
    batches = list(DataLoader(data, batch_size=5, num_workers=1, collate_fn=collate, multiprocessing_context="fork"))
    assert [len(batch["first"]["name"]) for batch in batches] == [5, 5, 2]
    assert batches[0]["truth"][0].source == "by hand"
    for batch, start in zip(batches, (0, 5, 10), strict=True):
        here = collate([data[i] for i in range(start, min(start + 5, len(data)))])
        for side in ("first", "second"):
            assert batch[side]["name"] == here[side]["name"]
            assert torch.equal(batch[side]["L"].to_dense(), here[side]["L"].to_dense())
            assert torch.equal(batch[side]["corr_mask"], here[side]["corr_mask"])
