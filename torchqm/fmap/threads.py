"""Small matrices are faster on one thread; whole tasks share the others."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock
from typing import Any, TypeVar

import torch
from threadpoolctl import OpenBLASController, ThreadpoolController

from torchqm.fmap.team import Team

__all__ = ["in_parallel", "in_shares", "one_thread", "shares", "threads_as_before", "workers"]

Item = TypeVar("Item")
Result = TypeVar("Result")

_TEAM: ContextVar[Team | None] = ContextVar("team", default=None)
_BEFORE: ContextVar[int] = ContextVar("before", default=0)  # torch's threads outside; 0 where no thread was taken


class _Blas:
    """BLAS has one number of threads for the whole process: the first to come limits it, the last to go restores it.

    threadpoolctl 3.8 lets one thread of Python set OpenBLAS's number and ignores all others, without a
    word. Here it is set under a lock, so whoever has that right loses it.
    """

    def __init__(self) -> None:
        self._lock, self._users, self._torch = Lock(), 0, 1
        self._limits: Any = None

    def take(self) -> int:
        """Limit it; returns how many threads torch has outside (each thread its own; new ones copy the last)."""
        with self._lock:
            if not self._users:
                self._torch = torch.get_num_threads()
                with _right_to_set():
                    # Selected, so that only these are restored: OpenMP's number is torch's and each thread's own.
                    self._limits = ThreadpoolController().select(user_api="blas").limit(limits=1)
            self._users += 1
            return self._torch

    def give_back(self) -> None:
        with self._lock:
            self._users -= 1
            if not self._users:
                with _right_to_set():
                    self._limits.restore_original_limits()


@contextmanager
def _right_to_set() -> Iterator[None]:
    clear = getattr(OpenBLASController, "clear_controlling_thread", lambda force: None)
    clear(force=True)
    try:
        yield
    finally:
        clear(force=True)


_BLAS = _Blas()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the body with one thread in torch and BLAS, and set what was set before after it.

    Thousands of products and eigenproblems of a hundred rows: threads only wait for each other there (2.4 seconds on
    one became 6.5 on two, and a minute where another process wants the cores, too). The threads that were allowed
    before are workers for :func:`in_parallel`. Several of Python's threads may be inside at the same time.

    Example:
        >>> with one_thread():
        ...     torch.get_num_threads()
        1
    """
    if _BEFORE.get():  # one inside another, or a task of a worker
        yield
        return
    before = _BLAS.take()
    team = Team(before)
    tokens = _TEAM.set(team), _BEFORE.set(before)
    torch.set_num_threads(1)
    patient = False
    try:
        yield
        patient = True
    except Exception:
        patient = True
        raise
    finally:
        try:
            team.close(patient)
        finally:
            _BLAS.give_back()
            torch.set_num_threads(before)
            _TEAM.reset(tokens[0])
            _BEFORE.reset(tokens[1])


@contextmanager
def threads_as_before() -> Iterator[None]:
    """Inside :func:`one_thread`, run the body as if outside of it: for what others wrote, such as a network.

    Not for several tasks at the same time.

    Example:
        >>> before = torch.get_num_threads()
        >>> with one_thread(), threads_as_before():
        ...     torch.get_num_threads() == before
        True
    """
    before = _BEFORE.get()
    if not before:
        yield
        return
    tokens = _TEAM.set(None), _BEFORE.set(0)
    _BLAS.give_back()
    torch.set_num_threads(before)
    try:
        yield
    finally:
        _BLAS.take()
        torch.set_num_threads(1)
        _TEAM.reset(tokens[0])
        _BEFORE.reset(tokens[1])


def workers() -> int:
    """How many tasks may run at the same time here; 1 outside :func:`one_thread`, where the libraries have threads.

    Tasks divide their own work by it, too: parts that nobody has time for just now are there for threads that are done.
    """
    team = _TEAM.get()
    return 1 if team is None else team.size


def shares(n: int) -> list[slice]:
    """Consecutive parts of ``n`` things, one for each of the :func:`workers`.

    Example:
        >>> shares(5)
        [slice(0, 5, None)]
    """
    size = max(1, -(-n // workers()))
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def in_parallel(tasks: Sequence[Callable[[], Result]]) -> list[Result]:
    """The results of some independent tasks, in order; as many run at a time as there are :func:`workers`.

    Tasks should be long (milliseconds) and spend their time where Python's lock is free: products, searches, sorting.
    Their results do not depend on the number of workers. They are begun in order, none after an error; of several
    errors the first task's is raised.

    Example:
        >>> in_parallel([lambda: 1, lambda: 2])
        [1, 2]
    """
    team = _TEAM.get()
    if team is None or team.size < 2 or len(tasks) < 2:
        return [task() for task in tasks]
    return team.run(tasks)


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
    before, n, inference = torch.get_num_threads(), min(n, len(items)), torch.is_inference_mode_enabled()

    def share(items: Sequence[Item]) -> None:
        torch.set_num_threads(1)  # of this thread; of those that start later, too, hence again below
        with torch.inference_mode(inference), torch.no_grad():  # what each thread has of its own
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
