"""A batch that cannot be trained on: the error that names its pairs, and the file that keeps it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchqm.geometry.files import write_whole

__all__ = ["StepError", "pair_names", "save_batch"]


class StepError(FloatingPointError, ValueError):
    """A loss or a gradient that is not finite, or numbers that a layer refuses; the message names the pairs."""


def pair_names(batch: Mapping[str, Any]) -> list[str]:
    """The pairs of a batch.

    Example:
        >>> pair_names({"first": {"name": ["a", "b"]}, "second": {"name": ["c", "d"]}})
        ['a -> c', 'b -> d']
    """
    return [f"{a} -> {b}" for a, b in zip(batch["first"]["name"], batch["second"]["name"], strict=True)]


def save_batch(path: Path, batch: Mapping[str, Any], **more: Any) -> Path:
    """Keep a batch and what belongs to it in a file for ``torch.load(path, weights_only=True)``.

    Args:
        path: where to; missing folders are made.
        batch: of pairs. Values that are neither tensors nor plain (a ``truth`` is an object) are left out.
        **more: further plain values and tensors, such as the weights.

    Returns:
        ``path``.
    """
    kept = {"pairs": pair_names(batch), "batch": _plain(batch), **{name: _plain(value) for name, value in more.items()}}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: torch.save(kept, file))
    return path


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.detach().cpu()
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items() if _is_plain(part)}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(_is_plain(part) for part in value)
    return value is None or isinstance(value, Tensor | Mapping | str | bool | int | float)
