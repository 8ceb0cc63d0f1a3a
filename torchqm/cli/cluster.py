"""The same work on the workers of a Dask cluster; what is lost with a worker is done by another.

Not through joblib, as its Dask backend waits for ever once a task has killed its workers.
"""

import logging
import os
import pickle
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, TypeVar
from uuid import uuid4

from torchqm.cli.backends import knock
from torchqm.cli.console import UserError
from torchqm.cli.processes import Failure, attempt
from torchqm.cli.threads import limit_to_one_thread
from torchqm.version import __version__

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["Cluster", "connected"]

T = TypeVar("T")
R = TypeVar("R")

CONNECT = 5.0
"""Seconds in which a scheduler must answer, and in which a first worker must be there."""

PATIENCE = 60.0
"""Seconds without any worker before a run gives up: a worker that died may be started again."""

UNSEEN = 90.0
"""Seconds in which a file that a worker wrote must be seen here: network file systems remember up to a minute what was
not there."""

_TICK = 1.0  # seconds between looks at who is there

_GO_ON = "what is done is kept, the same command goes on from there"


@contextmanager
def connected(address: str, folder: Path, needed: Sequence[Path] = ()) -> "Iterator[Cluster]":
    """A cluster whose workers can do the work: of this version of torchqm, and with the same files.

    Args:
        address: of the scheduler, ``tcp://HOST:PORT``.
        folder: absolute; where workers write.
        needed: absolute; other files or folders that they must see.

    Raises:
        UserError: nobody answers, there is no worker, or one differs (it is named).
    """
    from distributed import Client

    knock(address, CONNECT)
    log = logging.getLogger("distributed.client")
    level = log.level
    log.setLevel(logging.CRITICAL)  # what it has to say becomes an error in one line
    try:
        client = Client(address, timeout=CONNECT, set_as_default=False, name="torchqm")
    except (OSError, RuntimeError, TypeError, ValueError) as error:  # no answer, versions, certificates
        raise UserError(f"{address}: no connection to the Dask scheduler ({type(error).__name__}: {error})") from error
    probe = folder / f".probe-{uuid4().hex}"
    try:
        probe.write_text(probe.name)
        cluster = Cluster(client, address, probe, needed)
        cluster.wait_for_workers()
        yield cluster
    finally:
        probe.unlink(missing_ok=True)
        with suppress(TimeoutError, OSError):
            client.close(CONNECT)  # takes back what no worker has begun
        log.setLevel(level)


class Cluster:
    """The workers of a scheduler.

    Args:
        client: connection to the scheduler.
        address: of the scheduler, for messages.
        probe: a file in the folder that workers write to.
        needed: what else they must see.
    """

    def __init__(self, client: "Client", address: str, probe: Path, needed: Sequence[Path]) -> None:
        self.client, self.address, self.probe, self.needed = client, address, probe, list(needed)
        self.most = 0
        """Most workers there were at a time."""
        self.threads = 0
        """Their threads."""
        self._known = set[str]()

    def wait_for_workers(self) -> None:
        """Give the first worker a moment.

        Raises:
            UserError: there is none, or one that cannot do the work.
        """
        end = time.monotonic() + CONNECT
        while not self.workers():
            if time.monotonic() > end:
                raise UserError(f"{self.address}: the cluster has no worker ('dask worker {self.address}' starts one)")
            time.sleep(0.1)

    def workers(self) -> int:
        """How many workers there are now; those not seen before are looked at first.

        Raises:
            UserError: one cannot do the work, or the scheduler is gone.
        """
        try:
            with self._kept():
                there = self.client.nthreads()
                new = sorted(set(there) - self._known)
                if new:
                    self._look_at(new)
        except TimeoutError as error:
            raise UserError(f"{self.address}: the Dask scheduler does not answer; {_GO_ON}") from error
        usable = self._known & set(there)
        if len(usable) > self.most:
            self.most, self.threads = len(usable), sum(there[worker] for worker in usable)
        return len(usable)

    def _look_at(self, new: Sequence[str]) -> None:
        """Refuse workers with another torchqm or other files."""
        run = self.client.run
        # A function of the standard library: it can be asked for where there is no torchqm, or an old one.
        versions = run(resolve_name, "torchqm.version:__version__", workers=list(new), on_error="return")
        same = []
        for worker, version in versions.items():
            who = f"{self.address}: worker {worker}"
            if isinstance(version, OSError):  # gone again
                continue
            if isinstance(version, Exception):
                raise UserError(f"{who} has no torchqm ({version}); all need torchqm {__version__}")
            if version != __version__:
                raise UserError(f"{who} has torchqm {version}, this machine {__version__}; all need the same version")
            same.append(worker)
        for worker, found in run(_look, self.probe, self.needed, workers=same, on_error="return").items():
            who = f"{self.address}: worker {worker}"
            if isinstance(found, OSError):
                continue
            if not isinstance(found, Path):
                raise UserError(f"{who} {found}; all machines must share the set and the output folder")
            if not found.exists():
                raise UserError(
                    f"{who} writes to a {found.parent} of its own; all machines must share the output folder"
                )
            found.unlink()
            self._known.add(worker)

    def do(
        self, work: Callable[[T], R], tasks: Sequence[T], jobs: int | None = None
    ) -> Iterator[tuple[int, R | Failure]]:
        """Do ``work`` for each task and give the results as they come; as :func:`torchqm.cli.processes.in_processes`.

        No more is given to the scheduler than workers can do at once, so a worker that dies takes hardly any task with
        it but its own. The scheduler gives that to another worker; if several die over it, it is tried once more when
        all others are done, so that those that only were beside it are cleared.

        Args:
            work: a function of a module that workers have; where doing it twice does harm, it must look whether it was
                done: a worker can die between its end and the report.
            tasks: what to do; must be picklable.
            jobs: tasks at a time; default: one a worker.

        Yields:
            The number of a task and its result or failure.

        Raises:
            UserError: the scheduler or all workers are gone, or a new worker cannot do the work.
        """
        from distributed import wait
        from distributed.scheduler import KilledWorker

        run, seen = uuid4().hex, time.monotonic()
        waiting, suspects, tried = deque(range(len(tasks))), deque[int](), set[int]()
        running: dict[Future, int] = {}
        while waiting or suspects or running:
            room = min(self.workers(), jobs or len(tasks))
            if room:
                seen = time.monotonic()
            elif time.monotonic() - seen > PATIENCE:
                raise UserError(f"{self.address}: no worker is left; {_GO_ON}")
            queue = waiting or suspects
            while queue and len(running) < (room if queue is waiting else min(room, 1)):
                number = queue.popleft()
                key = f"torchqm-{run}-{number}{'-again' if number in tried else ''}"
                what = pickle.dumps((work, tasks[number]))
                with self._kept():
                    running[self.client.submit(_one, what, key=key, pure=False)] = number
            if not running:
                time.sleep(_TICK)
                continue
            with suppress(TimeoutError), self._kept(), self.client.as_current():
                wait(list(running), timeout=_TICK, return_when="FIRST_COMPLETED")
            for future in [future for future in running if future.done()]:
                try:
                    with self._kept():
                        error = future.exception()
                        result: R | Failure = Failure("") if error is not None else future.result(timeout=_TICK)
                except TimeoutError:  # its worker died with the result: another does it again
                    continue
                number = running.pop(future)
                future.release()  # else it would be done again if its worker died now
                if error is None:
                    yield number, result
                elif not isinstance(error, KilledWorker):  # not of the work, whose exceptions are results
                    self.workers()  # rather a new worker without torchqm
                    yield number, Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
                elif number not in tried:
                    tried.add(number)
                    suspects.append(number)
                else:
                    last = getattr(error.last_worker, "address", error.last_worker)
                    yield number, Failure(f"each worker that took it died (out of memory, or killed), the last {last}")

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """A scheduler that ends is an error for the user, whatever the client makes of it; only TimeoutError passes."""
        gone = f"{self.address}: the Dask scheduler is gone, or dropped the work; {_GO_ON}"
        if self.client.status != "running":  # calls would wait for it to come back
            raise UserError(gone)
        try:
            yield
        except (TimeoutError, UserError):
            raise
        except Exception as error:
            if isinstance(error, CancelledError | OSError) or self.client.status != "running":
                raise UserError(gone) from error
            raise

    def see(self, paths: Iterable[Path]) -> None:
        """Wait until files that workers wrote are seen here.

        Raises:
            UserError: one is not.
        """
        end = time.monotonic() + UNSEEN
        for path in paths:
            while not path.exists():
                if time.monotonic() > end:
                    raise UserError(f"{path}: a worker wrote it, but it is not seen here; {_GO_ON}")
                time.sleep(_TICK)


_turn = threading.Lock()


def _one(what: bytes) -> Any:
    """A task on a worker. In one process one at a time: warnings and caches are the process's, and become notes."""
    with _turn:
        limit_to_one_thread()
        return attempt(_load_and_do, what)


def _load_and_do(what: bytes) -> Any:
    # Not loaded by Dask, which does so where a worker hears the scheduler: one that cannot load what it is sent ends,
    # and its nanny with it.
    work, task = pickle.loads(what)
    return work(task)


def _look(probe: Path, needed: Sequence[Path]) -> Path | str:
    """On a worker: a file written beside the probe, or what is wrong, in words that follow the worker's name."""
    for path in needed:
        if not os.path.exists(path):  # Path.exists would raise where the worker may not look
            return f"does not see {path}"
    try:
        text = probe.read_text()
    except OSError:
        return f"does not see what is in {probe.parent}"
    answer = probe.with_name(f"{probe.name}-{uuid4().hex}")
    try:
        answer.write_text(text)
    except OSError as error:
        return f"cannot write to {probe.parent} ({error.strerror or error})"
    return answer
