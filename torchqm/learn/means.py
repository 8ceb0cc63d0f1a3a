"""Means over the pairs of all processes of a run."""

from typing import Any

from torch.distributed import all_gather_object, get_world_size, is_available, is_initialized

__all__ = ["PairMeans", "everywhere"]


def everywhere(value: Any) -> list[Any]:
    """What each process has, in their order; the value alone where there is one process. All must come here.

    Example:
        >>> everywhere({"a": 1})
        [{'a': 1}]
    """
    if not (is_available() and is_initialized()):
        return [value]
    found: list[Any] = [None] * get_world_size()
    all_gather_object(found, value)
    return found


class PairMeans:
    """Sums of values by name, with how many pairs they are of; processes may have other names and other numbers.

    Lightning's own means need every process to log the same names: one without a pair that has a truth would leave the
    others waiting.

    Example:
        >>> means = PairMeans()
        >>> means.add("error", 6.0, 2)
        >>> means.add("error", 3.0, 1)
        >>> means.add("other", 0.0, 0)
        >>> means.reduced()
        {'error': 3.0}
    """

    def __init__(self) -> None:
        self._sums: dict[str, tuple[float, int]] = {}

    def add(self, name: str, total: float, count: int) -> None:
        """Take in the sum over some pairs."""
        before, pairs = self._sums.get(name, (0.0, 0))
        self._sums[name] = before + total, pairs + count

    def reduced(self) -> dict[str, float]:
        """The means over the pairs of all processes; what no pair has a value of is left out. All must come here."""
        sums: dict[str, tuple[float, int]] = {}
        for own in everywhere(self._sums):
            for name, (total, count) in own.items():
                before, pairs = sums.get(name, (0.0, 0))
                sums[name] = before + total, pairs + count
        return {name: total / count for name, (total, count) in sums.items() if count}
