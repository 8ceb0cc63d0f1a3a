import pytest
import torch
from references.sets import Blobs

from torchqm.data.collate import collate, collate_with
from torchqm.data.dataset import PairDataset
from torchqm.data.items import ITEM_KEYS, ItemOptions, make_item

NAMES = ["two-0", "eight-0", "flat-0"]
SIZES = [162, 42, 30]


@pytest.fixture(scope="module")
def items():
    """Shapes of 162, 42 and 30 vertices with 2, 8 and 1 symmetries, and 10, 8 and 10 functions."""
    blobs = Blobs()
    options = ItemOptions(keys=ITEM_KEYS, k=10)
    out = [make_item(blobs, name, options) for name in NAMES]
    for key in ("evals", "evecs", "evecs_trans"):
        out[1][key] = out[1][key][:8] if key != "evecs" else out[1][key][:, :8]
    return out


@pytest.fixture(scope="module")
def batch(items):
    return collate(items)


def features(item, channels=4):
    """Any values at the vertices."""
    return torch.sin(item["verts"] @ torch.arange(1.0, 3.0 * channels + 1, dtype=torch.float64).reshape(3, -1))


def padded(items, n=162):
    return torch.stack([torch.nn.functional.pad(features(i), (0, 0, 0, n - len(i["verts"]))) for i in items])


def test_masks_say_what_is_real_and_padding_is_what_is_promised(items, batch):
    assert batch["name"] == NAMES
    assert batch["verts_mask"].sum(1).tolist() == SIZES
    assert batch["faces_mask"].sum(1).tolist() == [len(item["faces"]) for item in items]
    assert batch["evals_mask"].sum(1).tolist() == [10, 8, 10]
    assert batch["group_mask"].sum(1).tolist() == [2, 8, 1]
    for b, item in enumerate(items):
        v, f, k, g = (batch[f"{name}_mask"][b] for name in ("verts", "faces", "evals", "group"))
        assert torch.equal(batch["verts"][b][v], item["verts"])
        assert torch.equal(batch["faces"][b][f], item["faces"])
        assert torch.equal(batch["evecs"][b][v][:, k], item["evecs"])
        assert torch.equal(batch["evecs_trans"][b][k][:, v], item["evecs_trans"])
        assert torch.equal(batch["evals_even"][b][batch["evals_even_mask"][b]], item["evals_even"])
        assert torch.equal(batch["evecs_odd"][b][v][:, batch["evals_odd_mask"][b]], item["evecs_odd"])
        assert torch.equal(batch["dist"][b][v][:, v], item["dist"])
        assert torch.equal(batch["corr"][b][batch["corr_mask"][b]], item["corr"])
        assert torch.equal(batch["group"][b][g][:, v], item["group"])
        assert not batch["mass"][b][~v].any()
        assert not batch["evecs"][b][~v].any()
        assert not batch["evecs"][b][:, ~k].any()
        assert not batch["faces"][b][~f].any()
        assert torch.equal(batch["group"][b][:, ~v], torch.arange(162)[~v].expand(8, -1))


def test_areas_and_projections_come_out_as_for_each_shape_alone_without_a_mask(items, batch):
    a, b, c = (torch.gather(batch["verts"], 1, batch["faces"][:, :, i : i + 1].expand(-1, -1, 3)) for i in range(3))
    areas = torch.linalg.cross(b - a, c - a).norm(dim=2).sum(1) / 2
    assert torch.allclose(areas, torch.ones(3, dtype=torch.float64))
    coefficients = batch["evecs_trans"] @ padded(items)
    energies = (batch["evals"][:, :, None] * coefficients.square()).sum(1)
    for number, item in enumerate(items):
        alone = item["evecs_trans"] @ features(item)
        assert torch.allclose(coefficients[number][batch["evals_mask"][number]], alone, atol=1e-12)
        assert torch.allclose(energies[number], (item["evals"][:, None] * alone.square()).sum(0), atol=1e-10)


def test_functional_maps_solved_in_a_batch_are_those_of_each_pair(items, batch):
    """Least squares ``C A = B`` with masked functions weighed out, against the solution at its own size."""
    a = batch["evecs_trans"] @ padded(items)
    mask = batch["evals_mask"].to(torch.float64)
    penalty = torch.diag_embed(1e-3 + (1 - mask))
    c = torch.linalg.solve(a @ a.mT + penalty, a @ a.flip(0).mT).mT  # shape b to shape -b
    for number, item in enumerate(items):
        own = item["evecs_trans"] @ features(item)
        other = items[2 - number]["evecs_trans"] @ features(items[2 - number])
        alone = torch.linalg.solve(own @ own.T + 1e-3 * torch.eye(len(own)), own @ other.T).T
        rows, columns = batch["evals_mask"][2 - number], batch["evals_mask"][number]
        assert torch.allclose(c[number][rows][:, columns], alone, atol=1e-9)
        assert not c[number][~rows].any()
        assert not c[number][:, ~columns].any()


def test_means_and_nearest_neighbours_need_the_mask_and_are_right_with_it(items, batch):
    x, mask = padded(items), batch["verts_mask"]
    means = (x * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
    far = torch.cdist(x, x).masked_fill(~mask[:, None, :] | torch.eye(162, dtype=torch.bool), float("inf"))
    nearest = far.argmin(2)
    for number, item in enumerate(items):
        assert torch.allclose(means[number], features(item).mean(0))
        n = SIZES[number]
        alone = torch.cdist(features(item), features(item)).fill_diagonal_(float("inf"))
        found = far[number].gather(1, nearest[number][:, None])[:n, 0]
        assert torch.allclose(found, alone.min(1).values, atol=1e-7)
        assert int(nearest[number][:n].max()) < n


def test_orbit_means_with_the_mask_of_the_group_are_the_even_part(items, batch):
    x, weight = padded(items), batch["group_mask"].to(torch.float64)
    moved = torch.stack([x[b][batch["group"][b]] for b in range(3)])  # (B, G, V, C)
    even = (moved * weight[:, :, None, None]).sum(1) / weight.sum(1)[:, None, None]
    for number, item in enumerate(items):
        alone = features(item)[item["group"]].mean(0)
        assert torch.allclose(even[number][: SIZES[number]], alone, atol=1e-12)


@pytest.mark.parametrize("key", ["L", "gradX", "gradY"])
def test_sparse_matrices_act_as_each_alone_in_all_three_forms(items, key):
    x = padded(items)
    stacked, block, single = (collate_with(form)(items)[key] for form in ("stacked", "block", "list"))
    assert stacked.shape == (3, 162, 162)
    assert block.shape == (486, 486)
    assert stacked.is_sparse
    assert block.is_sparse
    rebuilt = torch.sparse_coo_tensor(stacked.indices(), stacked.values(), stacked.shape).coalesce()
    assert torch.equal(rebuilt.indices(), stacked.indices())  # sorted and without repetition, as it claims to be
    results = torch.bmm(stacked, x), (block @ x.reshape(486, -1)).reshape(3, 162, -1)
    for number, item in enumerate(items):
        n = SIZES[number]
        alone = item[key] @ features(item)
        for result in results:
            assert torch.allclose(result[number][:n], alone, atol=1e-12)
            assert not result[number][n:].any()
        assert single[number] is item[key]
        assert torch.equal((stacked[number] @ x[number])[:n], results[0][number][:n])  # as diffusion-net does it


def test_equal_sizes_are_only_stacked(items):
    batch = collate([items[0], items[0]])
    assert all(batch[mask].all() for mask in ("verts_mask", "faces_mask", "evals_mask", "corr_mask", "group_mask"))
    assert torch.equal(batch["evecs"][1], items[0]["evecs"])


def test_pairs_become_two_batches_and_a_list_of_truths():
    options = ItemOptions(keys=("mass", "corr"))
    data = PairDataset(Blobs(), "all", options=options, truth="optional")
    batch = collate([data[i] for i in range(3)])
    assert list(batch) == ["first", "second", "truth"]
    assert batch["first"]["name"] == ["two-0"] * 3
    assert batch["second"]["name"] == ["two-1", "eight-0", "flat-0"]
    assert batch["second"]["verts_mask"].sum(1).tolist() == [162, 42, 30]
    assert [truth is None for truth in batch["truth"]] == [False, True, True]
    assert batch["first"]["corr_mask"].sum(1).tolist() == [162, 0, 0]


def test_keys_of_the_user_are_stacked_where_they_can_be(items):
    some = [{"name": n, "label": torch.tensor(i), "wks": torch.zeros(i + 1, 2)} for i, n in enumerate("ab")]
    batch = collate(some)
    assert batch["label"].tolist() == [0, 1]
    assert [len(values) for values in batch["wks"]] == [1, 2]


def test_what_cannot_be_put_together_is_said(items):
    with pytest.raises(ValueError, match="items: none given"):
        collate([])
    with pytest.raises(ValueError, match=r"items: number 0 and number 1 have different keys \(dist, mass\)"):
        collate([{"name": "a", "mass": torch.ones(1)}, {"name": "b", "dist": torch.ones(1, 1)}])
    with pytest.raises(ValueError, match="sparse is 'dense'; allowed are stacked, block, list"):
        collate(items, "dense")
