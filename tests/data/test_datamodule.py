import pytest
import torch

from torchqm.data import PairDataset, open_shapes, write_split_file
from torchqm.data.datamodule import PairDataModule, SwappedTruths
from torchqm.data.items import ItemOptions
from torchqm.data.samplers import OnceSampler
from torchqm.data.splits import Split
from torchqm.fmap.orbit_truth import orbit_members

ROOT = "synthetic:kinds=ellipsoid;poses=3;verts=500;triangulation=shared"
NAMES = [f"ellipsoid-0-pose{pose}" for pose in range(3)]


def module(**given):
    return PairDataModule(**({"root": ROOT, "k": 8, "shares": (1, 0, 0)} | given))


def test_validation_and_test_are_sampled_once_and_lightning_keeps_it_so():
    data = module(shares=(0.4, 0.6, 0), test_root=ROOT, pairs="all+self")
    data.setup("fit")
    for loader in (data.val_dataloader(), data.test_dataloader()):
        assert isinstance(loader.sampler, OnceSampler)
        assert isinstance(loader.sampler, torch.utils.data.DistributedSampler)  # others are replaced, with padding


def test_pairs_without_a_truth_are_in_a_batch_with_masks_that_say_so():
    two = "synthetic:kinds=ellipsoid;bodies=2;poses=2;verts=500;triangulation=shared"
    data = module(root=two, pairs="unordered", truth="optional", batch_size=6)
    data.setup("fit")
    (batch,) = data.train_dataloader()
    names = zip(batch["first"]["name"], batch["second"]["name"], strict=True)
    within = [a.split("-pose")[0] == b.split("-pose")[0] for a, b in names]
    assert sorted(within) == [False] * 4 + [True] * 2
    for side in ("first", "second"):
        masks = batch[side]["corr_mask"]
        assert masks.any(-1).tolist() == within
        wanted = batch["first"]["verts_mask"].sum(-1) * torch.tensor(within)  # triangles are shared: at each vertex
        assert torch.equal(masks.sum(-1), wanted)


def test_batches_are_those_of_the_split_and_its_options(tmp_path):
    split = write_split_file(tmp_path / "split.yaml", Split(train=tuple(NAMES[:2]), test=(NAMES[0], NAMES[2])[1:]))
    data = module(split=str(split), batch_size=2, test_root=ROOT, pairs="unordered", dtype="float64")
    data.setup("fit")
    (batch,) = data.train_dataloader()
    assert (batch["first"]["name"], batch["second"]["name"]) == ([NAMES[0]], [NAMES[1]])
    assert batch["first"]["evecs"].shape[-1] == 8
    assert batch["first"]["evecs"].dtype == torch.float64
    assert data.val_dataloader() == []
    assert [len(part["first"]["name"]) for part in data.test_dataloader()] == [2, 1]


def test_bases_are_computed_once_into_the_cache(tmp_path):
    data = module(cache_dir=str(tmp_path))
    data.prepare_data()
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert len([path for path in files if path.suffix == ".npz"]) == 3
    data.setup("fit")
    for _ in data.train_dataloader():
        pass
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == files


def test_truths_are_swapped_in_the_share_that_was_asked_for():
    options = ItemOptions(keys=("group", "corr"), dtype=torch.float32)
    pairs = PairDataset(open_shapes(ROOT), options=options)
    wrong = SwappedTruths(pairs, 0.5, seed=1)
    assert len(wrong.swapped) == len(pairs) // 2 == 3
    for number in range(len(pairs)):
        true, found = pairs[number], wrong[number]
        group, corr = true["second"]["group"], found["second"]["corr"]
        elements = [g for g in range(len(group)) if torch.equal(group[g][true["second"]["corr"]], corr)]
        assert (elements == [0]) == (number not in wrong.swapped)
        assert len(elements) == 1
        assert torch.equal(wrong[number]["second"]["corr"], corr)  # drawn once, and the kept item stays as it was
    assert SwappedTruths(pairs, 0.5, seed=1).swapped == wrong.swapped
    with pytest.raises(ValueError, match=r"share: 1\.5 given"):
        SwappedTruths(pairs, 1.5)


@pytest.mark.parametrize(("triangulation", "same"), [("shared", True), ("own", False)])
def test_orbits_of_swapped_truths_are_the_same_where_the_group_is_exact(triangulation, same):
    """Why a supervision up to symmetry moves at all under swaps, and why configs/sweep/swapped.yaml shares them."""
    root = f"synthetic:kinds=biped;poses=2;verts=500;triangulation={triangulation}"
    pairs = PairDataset(open_shapes(root), "unordered", options=ItemOptions(keys=("group", "corr")))
    true, wrong = pairs[0]["second"], SwappedTruths(pairs, 1.0)[0]["second"]
    orbits = [orbit_members(side["corr"], side["group"]) for side in (true, wrong)]
    assert not torch.equal(true["corr"], wrong["corr"])
    assert torch.equal(*orbits) == same
    mirror = true["group"][1]
    assert torch.equal(mirror[mirror], torch.arange(len(mirror))) == same


def test_only_training_pairs_are_swapped():
    data = module(shares=(0.4, 0.6, 0), swapped=1.0, pairs="all+self")
    data.setup("fit")
    assert isinstance(data.parts["train"], SwappedTruths)
    assert isinstance(data.parts["validation"], PairDataset)


def test_only_the_classes_that_are_named_are_used(tmp_path):
    root = "synthetic:kinds=ellipsoid;bodies=3;poses=2;verts=500;triangulation=shared"
    chosen = ["ellipsoid-0", "ellipsoid-2"]
    data = module(root=root, classes=chosen, pairs="all", cache_dir=str(tmp_path))
    data.prepare_data()
    assert len(list(tmp_path.rglob("*.npz"))) == 4
    data.setup("fit")
    assert {name for pair in data.parts["train"].pairs for name in pair} == {
        f"{cls}-pose{pose}" for cls in chosen for pose in (0, 1)
    }
    whole = module(root=root, classes=chosen, shares=(0.5, 0.5, 0), whole_classes=True)
    whole.setup("fit")
    assert [len(whole.parts[part].pairs) for part in ("train", "validation")] == [2, 2]  # of two classes, not of three
    names = [f"ellipsoid-{body}-pose{pose}" for body in range(3) for pose in (0, 1)]
    split = write_split_file(tmp_path / "s.yaml", Split(train=tuple(names[:4]), validation=tuple(names[4:])))
    own = module(root=root, classes=chosen[:1], split=str(split))
    own.setup("fit")
    assert {name for pair in own.parts["train"].pairs for name in pair} == set(names[:2])
    assert own.parts["validation"] is None
    with pytest.raises(ValueError, match=r"classes: synthetic:.* has no 'elipsoid-1'; the nearest is 'ellipsoid-1'"):
        module(root=root, classes=["elipsoid-1"]).setup("fit")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"classes": []}, "classes: none given; null stands for all"),
        ({"dtype": "half"}, "dtype: 'half' given, allowed are float32, float64"),
        ({"batch_size": 0}, "batch_size: 0 given, expected at least 1"),
        ({"truth": "maybe"}, "truth: 'maybe' given, allowed are required, optional, none"),
        ({"swapped": 1.5}, "swapped: 1.5 given, expected 0 to 1"),
        ({"swapped": 0.5, "truth": "none"}, "swapped: needs a truth"),
        ({"swapped": 0.5, "keys": ("mass",)}, "swapped: needs a truth and the key 'group'"),
    ],
)
def test_bad_values_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        module(**given)


def test_a_part_without_pairs_is_an_error_when_it_is_needed():
    for stage, given, message in (
        ("fit", {"shares": (0, 0, 1)}, r"^shares: \[0, 0, 1\] given, .* leaves no shape for training"),
        ("test", {"shares": (1, 0, 0)}, r"^shares: \[1, 0, 0\] given, .* leaves no shape for the test"),
        ("test", {"shares": (0.9, 0, 0.1)}, r"^shares: 0\.1 of the shapes of a class in .* come to none for the test"),
        ("fit", {"shares": (0.4, 0.6, 0)}, r"^pairs: 'within-class' has no pair among the shapes of training \(elli"),
    ):
        with pytest.raises(ValueError, match=message):
            module(**given).setup(stage)
    with pytest.raises(ValueError, match="split: 'own' given, but synthetic:"):
        module(split="own").setup("fit")
