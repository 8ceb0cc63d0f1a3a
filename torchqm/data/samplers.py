"""In which order pairs are taken, and which process takes which."""

from collections.abc import Iterator

import torch
from torch.distributed import get_rank, get_world_size, is_available, is_initialized
from torch.utils.data import DistributedSampler

__all__ = ["EpochSampler", "OnceSampler"]


class EpochSampler(DistributedSampler[int]):
    """An order that depends on the seed and the number of the epoch alone, so that a run can be resumed at any epoch.

    Of n processes each takes every n-th of the order, so that their batches together are those that one process makes
    of n times as many (the first are taken again where their number is no multiple of n). Lightning would put a sampler
    of its own, with another order, around any that is no ``DistributedSampler``.

    Args:
        size: how many.
        seed: of the draw.
        replicas: processes; those of torch.distributed if not given, one if it does not run.
        rank: number of this process.

    Example:
        >>> sampler = EpochSampler(4, seed=1)
        >>> sampler.set_epoch(2)
        >>> list(sampler) == list(sampler), sorted(sampler)
        (True, [0, 1, 2, 3])
        >>> parts = [list(EpochSampler(4, seed=1, replicas=2, rank=rank)) for rank in (0, 1)]
        >>> [v for pair in zip(*parts) for v in pair] == list(EpochSampler(4, seed=1))
        True
    """

    def __init__(self, size: int, seed: int = 0, replicas: int | None = None, rank: int | None = None) -> None:
        super().__init__(range(size), *_processes(replicas, rank), seed=seed)  # type: ignore[arg-type]
        self.size = size

    def __iter__(self) -> Iterator[int]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
        order = torch.randperm(self.size, generator=generator).tolist()
        order += order * (self.total_size // max(self.size, 1))
        return iter(order[: self.total_size][self.rank :: self.num_replicas])


class OnceSampler(DistributedSampler[int]):
    """All in their order, each in one process only: where means are taken, none may count twice.

    torch's own sampler takes the first again until all processes have as many. Where there are fewer than processes,
    each process takes all of them, which leaves every mean as it is and no process without work.

    Args:
        size: how many.
        replicas: processes; those of torch.distributed if not given, one if it does not run.
        rank: number of this process.

    Example:
        >>> [list(OnceSampler(5, replicas=2, rank=rank)) for rank in (0, 1)]
        [[0, 2, 4], [1, 3]]
        >>> [list(OnceSampler(2, replicas=3, rank=rank)) for rank in (0, 1, 2)]
        [[0, 1], [0, 1], [0, 1]]
    """

    def __init__(self, size: int, replicas: int | None = None, rank: int | None = None) -> None:
        super().__init__(range(size), *_processes(replicas, rank), shuffle=False)  # type: ignore[arg-type]
        self._own = range(self.rank, size, self.num_replicas) if size >= self.num_replicas else range(size)

    def __iter__(self) -> Iterator[int]:
        return iter(self._own)

    def __len__(self) -> int:
        return len(self._own)


def _processes(replicas: int | None, rank: int | None) -> tuple[int, int | None]:
    """How many there are, and the number of this one."""
    if replicas is not None:
        return replicas, rank
    return (get_world_size(), get_rank()) if is_available() and is_initialized() else (1, 0)
