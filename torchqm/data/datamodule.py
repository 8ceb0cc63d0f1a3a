"""Pairs of a set of shapes as a LightningDataModule; needs the extra ``learn`` (pytorch-lightning).

It stands here and not in :mod:`torchqm.learn`, since what is learned must not know where shapes come from.
"""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from torchqm.data.base import ShapeSet
from torchqm.data.collate import collate
from torchqm.data.dataset import TRUTH_USES, PairDataset
from torchqm.data.items import ItemOptions, make_item
from torchqm.data.layouts import open_shapes
from torchqm.data.pairs import choose_pairs
from torchqm.data.samplers import EpochSampler, OnceSampler
from torchqm.data.splits import PARTS, Split, draw_split, own_split, read_split_file

__all__ = ["PairDataModule", "SwappedTruths"]

Item = dict[str, Any]
DTYPES = {"float32": torch.float32, "float64": torch.float64}


class SwappedTruths(Dataset[Item]):
    """Pairs, a share of them with a truth that is followed by a symmetry of the second shape: left and right swapped.

    What a labeller does who does not know which side is left. The pairs and the elements (any but the identity) are
    drawn once, from the seed. Only ``corr`` is swapped; ``truth`` stays as it is. Where the group is one of nearest
    vertices (creatures with triangles of their own) a swapped truth is rounded once more, so a less exact label; and
    its orbit is another, since such a table is no exact group.

    Args:
        pairs: with ``corr`` and ``group``.
        share: from 0 to 1.
        seed: of the draw.

    Raises:
        ValueError: ``share`` is none.
    """

    def __init__(self, pairs: PairDataset, share: float, seed: int = 0) -> None:
        if not 0 <= share <= 1:
            raise ValueError(f"share: {share} given, expected 0 to 1")
        self.pairs = pairs
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(pairs), generator=generator)
        self.swapped = frozenset(order[: round(share * len(pairs))].tolist())
        self._draws = torch.rand(len(pairs), generator=generator, dtype=torch.float64).tolist()

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> Item:
        pair = self.pairs[index]
        group = pair["second"]["group"]
        if index in self.swapped and len(group) > 1:
            element = 1 + int(self._draws[index] * (len(group) - 1))
            pair["second"]["corr"] = group[element][pair["second"]["corr"]]
        return pair


class PairDataModule(LightningDataModule):
    """Pairs to train, validate and test on, from the shapes of a folder or the built-in creatures.

    Batches are those of :func:`torchqm.data.collate` without ``truth``, which is for measuring in the end.

    Args:
        root: what :func:`torchqm.data.open_shapes` understands: a folder, or ``synthetic:...``.
        pairs: which pairs of each part, in the words of :func:`torchqm.data.choose_pairs`.
        split: ``draw``, ``own`` (that of the set), or a YAML file of :func:`torchqm.data.write_split_file`.
        shares: of train, validation and test, where the split is drawn.
        whole_classes: draw whole classes: validate and test on bodies never seen.
        classes: use the shapes of these classes only, before they are split; all if not given.
        test_root: other shapes to test on, all of them, whatever ``classes`` says; those of the split if not given.
        k: eigenfunctions.
        keys: of the items, see :class:`torchqm.data.ItemOptions`; ``corr`` is added where a truth is read.
        dtype: ``float32`` or ``float64``.
        cache_dir: folder of the spectral cache; bases are computed into it once, before training.
        batch_size: pairs.
        workers: processes that load pairs.
        seed: draws the split, the order of the pairs and the swapped truths.
        truth: ``required``, ``optional`` or ``none``, as :class:`torchqm.data.PairDataset`.
        swapped: share of the training pairs whose truth has left and right swapped (:class:`SwappedTruths`).
        keep: shapes kept in memory; None for all.

    Raises:
        ValueError: a word or number that is not allowed; in ``setup``, a part without pairs (validation may be empty).

    Example:
        >>> module = PairDataModule("synthetic:kinds=ellipsoid;verts=500;triangulation=shared", shares=(1, 0, 0), k=10)
        >>> module.setup("fit")
        >>> len(module.train_dataloader()), module.val_dataloader()
        (6, [])
    """

    def __init__(
        self,
        root: str,
        pairs: str = "within-class",
        split: str = "draw",
        shares: Sequence[float] = (0.6, 0.2, 0.2),
        whole_classes: bool = False,
        classes: Sequence[str] | None = None,
        test_root: str | None = None,
        k: int = 60,
        keys: Sequence[str] = ("mass", "basis", "group"),
        dtype: str = "float32",
        cache_dir: str | None = None,
        batch_size: int = 1,
        workers: int = 0,
        seed: int = 0,
        truth: str = "required",
        swapped: float = 0.0,
        keep: int | None = None,
    ) -> None:
        super().__init__()
        if dtype not in DTYPES:
            raise ValueError(f"dtype: {dtype!r} given, allowed are {', '.join(DTYPES)}")
        if truth not in TRUTH_USES:
            raise ValueError(f"truth: {truth!r} given, allowed are {', '.join(TRUTH_USES)}")
        for name, value, least in (("batch_size", batch_size, 1), ("workers", workers, 0)):
            if value < least:
                raise ValueError(f"{name}: {value} given, expected at least {least}")
        if not 0 <= swapped <= 1:
            raise ValueError(f"swapped: {swapped} given, expected 0 to 1")
        if swapped and (truth == "none" or ("group" not in keys and "symmetry" not in keys)):
            raise ValueError("swapped: needs a truth and the key 'group'")
        shares, keys, classes = list(shares), list(keys), None if classes is None else list(classes)
        if classes == []:
            raise ValueError("classes: none given; null stands for all")
        self.save_hyperparameters()
        corr = () if truth == "none" else ("corr",)
        self.options = ItemOptions(keys=(*keys, *corr), k=k, dtype=DTYPES[dtype], cache_dir=cache_dir)
        self.parts: dict[str, PairDataset | SwappedTruths | None] = {}

    def prepare_data(self) -> None:
        """Compute all bases once, into the cache, if there is a folder for it; called by one process only."""
        given = self.hparams
        if given["cache_dir"] is None:
            return
        only = ItemOptions(keys=("evals",), k=given["k"], cache_dir=given["cache_dir"])
        for root, classes in ((given["root"], given["classes"]), (given["test_root"], None)):
            if root is None:
                continue
            shapes = open_shapes(root)
            for name in dict.fromkeys(name for pair in choose_pairs(shapes, given["pairs"]) for name in pair):
                if classes is None or shapes.shape_class(name) in classes:
                    make_item(shapes, name, only)

    def setup(self, stage: str) -> None:
        """Open the set and choose the pairs of each part."""
        if self.parts:
            return
        given = self.hparams
        shapes = open_shapes(given["root"])
        split = self._split(shapes)
        self.parts["train"] = self._pairs(shapes, "train", split.train, needed=stage == "fit")
        self.parts["validation"] = self._pairs(shapes, "validation", split.validation, needed=False)
        if given["test_root"] is None:
            self.parts["test"] = self._pairs(shapes, "test", split.test, needed=stage == "test")
        else:
            others = open_shapes(given["test_root"])
            self.parts["test"] = self._pairs(others, "test", tuple(others.names), needed=stage == "test")
        train = self.parts["train"]
        if given["swapped"] and isinstance(train, PairDataset):
            self.parts["train"] = SwappedTruths(train, given["swapped"], given["seed"])

    def train_dataloader(self) -> DataLoader[Item]:
        """Pairs in an order drawn anew for each epoch."""
        return self._loader("train")

    def val_dataloader(self) -> DataLoader[Item] | list[Any]:
        """Pairs in their order; none if the part is empty."""
        return [] if self.parts["validation"] is None else self._loader("validation")

    def test_dataloader(self) -> DataLoader[Item] | list[Any]:
        """Pairs in their order."""
        return [] if self.parts["test"] is None else self._loader("test")

    def _split(self, shapes: ShapeSet) -> Split:
        given = self.hparams
        classes = given["classes"]
        for cls in classes or ():
            if cls not in shapes.classes:
                near = get_close_matches(cls, shapes.classes, 1, 0.5)
                hint = f"the nearest is {near[0]!r}" if near else f"there are {', '.join(shapes.classes)}"
                raise ValueError(f"classes: {shapes.root} has no {cls!r}; {hint}")
        if given["split"] == "draw":
            return draw_split(shapes, given["shares"], given["seed"], given["whole_classes"], classes)
        split = own_split(shapes) if given["split"] == "own" else read_split_file(Path(given["split"]), shapes)
        if split is None:
            raise ValueError(f"split: 'own' given, but {shapes.root} ships none; allowed are draw and a file")
        if classes is None:
            return split
        return Split(*(tuple(v for v in split.part(p) if shapes.shape_class(v) in classes) for p in PARTS))

    def _pairs(self, shapes: ShapeSet, part: str, names: tuple[str, ...], needed: bool) -> PairDataset | None:
        given = self.hparams
        chosen = [pair for pair in choose_pairs(shapes, given["pairs"]) if set(pair) <= set(names)]
        if not chosen:
            if needed:
                raise ValueError(self._why_none(shapes, part, names))
            return None
        return PairDataset(shapes, chosen, None, self.options, given["truth"], given["keep"])

    def _why_none(self, shapes: ShapeSet, part: str, names: tuple[str, ...]) -> str:
        """Which option leaves a part without a pair."""
        given = self.hparams
        what = {"train": "training", "test": "the test"}.get(part, part)
        if names:
            return f"pairs: {given['pairs']!r} has no pair among the shapes of {what} ({', '.join(names)})"
        if given["split"] != "draw":
            return f"split: {given['split']!r} has no shape for {what}"
        share = given["shares"][PARTS.index(part)]
        if share == 0:
            return f"shares: {given['shares']} given, of train, validation and test, which leaves no shape for {what}"
        kind = "classes" if given["whole_classes"] else "shapes of a class"
        return f"shares: {share} of the {kind} in {shapes.root} come to none for {what}; give it more"

    def _loader(self, part: str) -> DataLoader[Item]:
        pairs, given = self.parts[part], self.hparams
        if pairs is None:
            raise ValueError(f"shares: no pair of {given['root']} is in the part {part}")
        return DataLoader(
            pairs,
            batch_size=given["batch_size"],
            sampler=EpochSampler(len(pairs), given["seed"]) if part == "train" else OnceSampler(len(pairs)),
            num_workers=given["workers"],
            persistent_workers=given["workers"] > 0,
            collate_fn=_batch,
        )


def _batch(pairs: Sequence[Item]) -> Item:
    """Without the truths, objects that Lightning cannot convert to another precision; ``corr`` is trained on."""
    return collate([{key: value for key, value in pair.items() if key != "truth"} for pair in pairs])
