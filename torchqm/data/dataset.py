"""Sets of shapes and of pairs as torch datasets."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import zeros
from torch.utils.data import Dataset

from torchqm.data.base import ShapeSet, Truth, TruthError, TruthFileError
from torchqm.data.items import ItemOptions, make_item
from torchqm.data.pairs import choose_pairs

__all__ = ["PairDataset", "ShapeDataset"]

Item = dict[str, Any]
TRUTH_USES = ("required", "optional", "none")


class ShapeDataset(Dataset[Item]):
    """The shapes of a set, each as a dictionary (see :mod:`torchqm.data.items`).

    Args:
        shapes: the set.
        names: which of its shapes, in which order; all if not given. A part of a split, for example.
        options: what is made of each.
        keep: how many items stay in memory, the last ones used; None for all. Their tensors are shared, not copied.
        transform: called with a copy of each item when it is asked for (augmentation, features); what it returns is
            handed out.

    Raises:
        ValueError: a name that the set does not have.

    Example:
        >>> from torchqm.data.synthetic_set import SyntheticShapes
        >>> shapes = SyntheticShapes("synthetic:kinds=ellipsoid;verts=500;triangulation=shared")
        >>> data = ShapeDataset(shapes, options=ItemOptions(keys=("basis",), k=10))
        >>> len(data), list(data[0])
        (3, ['name', 'verts', 'faces', 'evals', 'evecs', 'evecs_trans'])
    """

    def __init__(
        self,
        shapes: ShapeSet,
        names: Sequence[str] | None = None,
        options: ItemOptions | None = None,
        keep: int | None = 4,
        transform: Callable[[Item], Item] | None = None,
    ) -> None:
        self.shapes = shapes
        self.names = list(shapes.names if names is None else names)
        shapes.require(*self.names)
        self.options = options or ItemOptions()
        self.keep = keep
        self.transform = transform
        self._items: OrderedDict[str, Item] = OrderedDict()

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Item:
        return self.item(self.names[index])

    def item(self, name: str) -> Item:
        """The item of a shape by its name."""
        if name in self._items:
            self._items.move_to_end(name)
            made = self._items[name]
        else:
            made = self._items[name] = make_item(self.shapes, name, self.options)
            while self.keep is not None and len(self._items) > self.keep:
                self._items.popitem(last=False)
        return dict(made) if self.transform is None else self.transform(dict(made))


class PairDataset(Dataset[Item]):
    """Pairs of a set: ``{"first": item, "second": item, "truth": Truth}``.

    Where the keys ask for ``corr``, it is the truth of the pair: row i of ``first["corr"]`` goes to row i of
    ``second["corr"]`` (a point inside a face to its nearest corner; ``truth`` has it exactly).

    Args:
        shapes: the set.
        pairs: what :func:`torchqm.data.pairs.choose_pairs` understands, or the pairs themselves.
        names: only pairs of these shapes; a part of a split, for example.
        options: what is made of each shape.
        truth: ``required``: a pair without truth is an error when it is asked for; ``optional``: its ``truth`` is None
            and its ``corr`` is empty; ``none``: no truth is read, and a ``corr`` that is asked for comes from the
            shapes' template.
        keep: how many shapes stay in memory, the last ones used; None for all.
        transform: called with a copy of the item of each shape.

    Raises:
        ValueError: an unknown ``truth``, pairs that cannot be had, or none.

    Example:
        >>> from torchqm.data.synthetic_set import SyntheticShapes
        >>> shapes = SyntheticShapes("synthetic:kinds=ellipsoid;verts=500;triangulation=shared")
        >>> data = PairDataset(shapes, "unordered", options=ItemOptions(keys=("mass", "corr")))
        >>> pair = data[0]
        >>> len(data), pair["second"]["name"], pair["truth"].source
        (3, 'ellipsoid-0-pose1', 'vertex ids agree on the body ellipsoid-0')
    """

    def __init__(
        self,
        shapes: ShapeSet,
        pairs: str | Path | Sequence[tuple[str, str]] = "all",
        names: Sequence[str] | None = None,
        options: ItemOptions | None = None,
        truth: str = "required",
        keep: int | None = 4,
        transform: Callable[[Item], Item] | None = None,
    ) -> None:
        if truth not in TRUTH_USES:
            raise ValueError(f"truth is {truth!r}; allowed are {', '.join(TRUTH_USES)}")
        chosen = choose_pairs(shapes, pairs) if isinstance(pairs, str | Path) else [(a, b) for a, b in pairs]
        if names is not None:
            shapes.require(*names)
            chosen = [pair for pair in chosen if set(pair) <= set(names)]
        if not chosen:
            raise ValueError(f"pairs: none left of {pairs if isinstance(pairs, str | Path) else 'those given'}")
        self.pairs = chosen
        self.truth_use = truth
        used = list(dict.fromkeys(name for pair in chosen for name in pair))
        options = options or ItemOptions()
        self._with_corr = "corr" in options.wanted and truth != "none"
        if self._with_corr:
            rest = tuple(key for key in options.wanted if key != "corr")
            options = replace(options, keys=rest)
        self.items = ShapeDataset(shapes, used, options, keep, transform)

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> Item:
        first, second = self.pairs[index]
        pair: Item = {"first": self.items.item(first), "second": self.items.item(second)}
        if self.truth_use == "none":
            return pair
        pair["truth"] = truth = self._truth(first, second)
        if self._with_corr:
            none = zeros(0).long()
            pair["first"]["corr"] = none if truth is None else truth.at
            pair["second"]["corr"] = none if truth is None else truth.vertices
        return pair

    def _truth(self, first: str, second: str) -> Truth | None:
        try:
            return self.items.shapes.truth(first, second)
        except TruthError as error:
            # Optional is a truth that there may be none of, not one whose file is damaged.
            if self.truth_use == "required" or isinstance(error, TruthFileError):
                raise
            return None
