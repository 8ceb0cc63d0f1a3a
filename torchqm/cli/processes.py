"""The same work on many things, in processes of one thread each; one that fails or dies does not stop the others.

Not through joblib: its loky backend does not say which tasks were running when a process died, and its processes go on
when the one that started them is killed.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

from torchqm.cli.threads import limit_to_one_thread

__all__ = ["Failure", "attempt", "in_processes", "usable_cores"]

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Failure:
    """Why there is no result, in a sentence."""

    reason: str


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_processes(work: Callable[[T], R], tasks: Sequence[T], jobs: int = 1) -> Iterator[tuple[int, R | Failure]]:
    """Do ``work`` for each task and give the results as they come.

    An exception becomes a :class:`Failure`. If a process dies (out of memory, killed), the tasks that were running are
    tried once more, each in a process of its own, so that the one at fault is found and the others are done.

    Args:
        work: a function of a module, so that another process can import it.
        tasks: what to do; must be picklable.
        jobs: processes; 1: this one does everything.

    Yields:
        The number of a task and its result or failure.
    """
    if jobs <= 1 or len(tasks) <= 1:
        for number, task in enumerate(tasks):
            yield number, attempt(work, task)
        return
    waiting, suspects = deque(range(len(tasks))), list[int]()
    while waiting:
        running: dict[Future[R | Failure], int] = {}
        with _pool(min(jobs, len(waiting))) as pool:
            try:
                while waiting or running:
                    while waiting and len(running) < jobs:  # no more: then those that run when it breaks are known
                        running[pool.submit(attempt, work, tasks[waiting[0]])] = waiting[0]
                        waiting.popleft()
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        result = future.result()
                        yield running.pop(future), result
            except BrokenProcessPool:
                suspects += running.values()
            except BaseException:  # interrupted, or nobody wants more: do not wait for what is running
                for process in list((getattr(pool, "_processes", None) or {}).values()):
                    process.terminate()
                raise
    for number in suspects:
        with _pool(1) as pool:
            try:
                alone = pool.submit(attempt, work, tasks[number]).result()
            except BrokenProcessPool:
                alone = Failure("its process died (out of memory, or killed)")
        yield number, alone


def attempt(work: Callable[[T], R], task: T) -> R | Failure:
    """The result of one task, or why there is none."""
    try:
        return work(task)
    except Exception as error:  # whatever it is, it belongs to this task alone
        text = " ".join(str(error).split())
        return Failure(text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}")


def _pool(n: int) -> ProcessPoolExecutor:
    # Spawned, not forked: libraries with threads do not survive a fork.
    return ProcessPoolExecutor(n, multiprocessing.get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Before anything heavy is imported: one thread, and an end as soon as the parent ends, however it does."""
    limit_to_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback from each process on Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
