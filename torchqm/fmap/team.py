"""A few threads that share tasks, and the tasks that these make in turn."""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import Context, copy_context
from threading import Condition, Thread
from typing import Any

import torch

__all__ = ["Team"]


class _Job:
    """The tasks of one call and what has come of them.

    Args:
        tasks: which.
    """

    def __init__(self, tasks: Sequence[Callable[[], Any]]) -> None:
        self.tasks, self.left = tasks, len(tasks)
        self.waiting = deque(range(len(tasks)))
        self.results: dict[int, Any] = {}
        self.errors: dict[int, BaseException] = {}
        self.contexts: list[Context] = [copy_context() for _ in tasks]  # one cannot be entered twice at a time
        self.grad, self.inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def run(self, number: int) -> None:
        """Run a task as the caller: its context, its gradients; autocast and default devices are a thread's own."""
        try:
            with torch.inference_mode(self.inference), torch.set_grad_enabled(self.grad):
                self.results[number] = self.contexts[number].run(self.tasks[number])
        except BaseException as error:
            self.errors[number] = error


class Team:
    """Threads that share tasks: the one that makes the team, and helpers that wait for work.

    A thread that waits for its last tasks to end, which others are running, runs parts of these meanwhile, if they call
    :meth:`run` themselves. So uneven tasks keep all threads busy as long as they can be divided, and there are never
    more of them at work than the team has.

    Args:
        size: number of threads.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._closed = False
        self._jobs: list[_Job] = []
        self._helpers: list[Thread] = []
        self._changed = Condition()

    def run(self, tasks: Sequence[Callable[[], Any]]) -> list[Any]:
        """The results of some tasks, in order. They are begun in order, none after an error; the first one is raised.

        Only threads at work for the team may call this: the one that made it, and tasks.
        """
        job = _Job(tasks)
        self._changed.acquire()
        try:
            self._jobs.append(job)
            self._hire(min(self.size - 1, len(tasks) - 1))
            self._changed.notify_all()
            self._serve(job)
        finally:
            # An interrupt can come while the lock is taken or given away.
            if job in self._jobs:
                self._jobs.remove(job)
            self._let_go()
        if job.errors:
            # What asks the process to end comes before what went wrong in it.
            raise job.errors[min(job.errors, key=lambda number: (isinstance(job.errors[number], Exception), number))]
        return [job.results[number] for number in range(len(tasks))]

    def close(self, wait: bool = True) -> None:
        """End the helpers, and wait for them unless the caller has been interrupted: they may be at a long task."""
        self._closed = True
        with self._changed:
            self._changed.notify_all()
        self._let_go()
        for helper in self._helpers if wait else ():
            helper.join()

    def _hire(self, n: int) -> None:
        """Have n helpers; fewer where the system gives no more threads: whoever has tasks can do them alone."""
        while len(self._helpers) < n:
            helper = Thread(target=self._help, daemon=True)
            try:
                helper.start()
            except RuntimeError:
                return
            self._helpers.append(helper)

    def _let_go(self) -> None:
        """Give the lock away, as often as this thread has it."""
        with suppress(RuntimeError):
            while True:
                self._changed.release()

    def _help(self) -> None:
        torch.set_num_threads(1)
        with self._changed:
            self._serve(None)

    def _serve(self, mine: _Job | None) -> None:
        """Run tasks until those of a job are done (of a helper: until the team is closed); the lock is held outside."""
        while not self._closed if mine is None else mine.left:
            job = self._next(mine)
            if job is None:
                self._changed.wait()
                continue
            number = job.waiting.popleft()
            self._changed.release()
            try:
                job.run(number)
            finally:
                self._changed.acquire()
            job.left -= 1
            if job.errors:
                job.left -= len(job.waiting)
                job.waiting.clear()
            if not job.left:
                self._changed.notify_all()
            error = job.errors.get(number)
            if mine is not None and error is not None and not isinstance(error, Exception):
                raise error  # an interrupt: what others are at is left to itself

    def _next(self, mine: _Job | None) -> _Job | None:
        """A job with tasks that nobody has begun: the own one first, else the newest, which may be a part of it."""
        if mine is not None and mine.waiting:
            return mine
        newer = self._jobs if mine is None else self._jobs[self._jobs.index(mine) :]
        return next((job for job in reversed(newer) if job.waiting), None)
