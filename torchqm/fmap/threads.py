"""Small matrices are faster on one thread; whole tasks share the others."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import TypeVar

import torch
from threadpoolctl import threadpool_limits

__all__ = ["in_parallel", "in_shares", "one_thread", "workers"]

Item = TypeVar("Item")
Result = TypeVar("Result")

_WORKERS: ContextVar[int] = ContextVar("workers", default=1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the body with one thread in torch and BLAS, and set what was set before after it.

    Thousands of products and eigenproblems of a hundred rows: threads only wait for each other there (2.4 seconds on
    one became 6.5 on two, and a minute where another process wants the cores, too). The threads that were allowed
    before are workers for :func:`in_parallel`.

    Example:
        >>> with one_thread():
        ...     torch.get_num_threads()
        1
    """
    before = torch.get_num_threads()
    token = _WORKERS.set(max(before, _WORKERS.get()))
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, "blas"):
            yield
    finally:
        torch.set_num_threads(before)
        _WORKERS.reset(token)


def workers() -> int:
    """How many tasks may run at the same time here; 1 outside :func:`one_thread`, where the libraries have threads."""
    return _WORKERS.get()


def in_parallel(tasks: Sequence[Callable[[], Result]]) -> list[Result]:
    """The results of some independent tasks, in order; as many run at a time as there are workers.

    Tasks should be long (milliseconds) and spend their time where Python's lock is free: products, searches, sorting.
    Their results do not depend on the number of workers. Of several errors the first task's is raised.

    Example:
        >>> in_parallel([lambda: 1, lambda: 2])
        [1, 2]
    """
    n = min(workers(), len(tasks))
    if n <= 1:
        return [task() for task in tasks]
    share = max(1, workers() // n)

    def run(task: Callable[[], Result]) -> Result:
        _WORKERS.set(share)  # of this thread's own copy of the context
        return task()

    with ThreadPoolExecutor(n) as pool:
        futures = [pool.submit(copy_context().run, run, task) for task in tasks]
        return [future.result() for future in futures]


def in_shares(run: Callable[[Sequence[Item]], None], items: Sequence[Item], n: int) -> None:
    """Call ``run`` on every n-th item, starting at each of the first n, on n threads of their own.

    For loops over batched LAPACK calls, which torch runs on one thread only, whatever it was given. Each share runs
    with one thread in torch and without gradients: ``run`` writes into tensors made before. With n = 1 ``run`` gets
    all items and is called here.

    Example:
        >>> found = torch.zeros(4)
        >>> def run(items):
        ...     for i in items:
        ...         found[i] = 2 * i
        >>> in_shares(run, range(4), 2)
        >>> found.tolist()
        [0.0, 2.0, 4.0, 6.0]
    """
    before, n = torch.get_num_threads(), min(n, len(items))

    @torch.no_grad()
    def share(items: Sequence[Item]) -> None:
        torch.set_num_threads(1)  # of this thread; of those that start later, too, hence again below
        run(items)

    if n <= 1:
        run(items)
        return
    try:
        with ThreadPoolExecutor(n) as pool:
            futures = [pool.submit(share, items[first::n]) for first in range(n)]
            for future in futures:
                future.result()
    finally:
        torch.set_num_threads(before)
