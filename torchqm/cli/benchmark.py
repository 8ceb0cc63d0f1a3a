"""``torchqm benchmark``: many methods on many pairs, in several processes, gone on with after a kill."""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from torchqm.cli.backends import check_backend
from torchqm.cli.benchmark_help import DESCRIPTION, add_options
from torchqm.cli.cluster import connected
from torchqm.cli.console import Progress, UserError
from torchqm.cli.inputs import as_plain
from torchqm.cli.processes import Failure, in_processes, usable_cores

if TYPE_CHECKING:
    from torchqm.benchmark import Task
    from torchqm.benchmark.page import Picture
    from torchqm.benchmark.summary import PublishedRows
    from torchqm.data.base import ShapeSet

__all__ = ["FILES", "add_parser", "run"]

_RunAll = Callable[[Callable[[Any], Any], "Sequence[Task]"], Iterable[tuple[int, Any]]]
"""Does work for tasks and gives the number and result of each as they come."""

FILES = ("pairs.csv", "table.md", "worst.html", "run.json")


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "benchmark",
        help="compare methods on the pairs of a set of shapes",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    add_options(parser)
    parser.set_defaults(run=run, threads=None, default_threads=1)


def run(arguments: argparse.Namespace) -> int:
    """Run what is missing and write the report; 1 if a pair failed."""
    dask = arguments.backend == "dask"
    check_backend(arguments.backend, arguments.address)
    if dask:  # workers are started anywhere
        arguments.out = arguments.out.absolute()
        if not arguments.root.startswith("synthetic:"):
            arguments.root = str(Path(arguments.root).absolute())
    shapes, pairs, tasks, published = _plan(arguments)
    out = arguments.out
    with _locked(out):
        from torchqm.benchmark.ledger import clean
        from torchqm.benchmark.runs import begin_run, end_run

        clean(out, 3600.0 if dask else 0.0)
        todo = [] if arguments.report else _missing(tasks, arguments.retry)
        title = f"Comparison on {arguments.root}"
        print(f"{shapes.recognised[0]}; {len(pairs)} pairs, {len(tasks) - len(todo)} of {len(tasks)} results are there")
        try:
            with _backend(arguments, todo) as (run_all, backend), Progress() as progress:
                if arguments.retry:
                    _forget(todo)
                if todo:
                    begin_run(out, as_plain(arguments), backend)
                    _do(todo, len(tasks), run_all, progress)
                    end_run(out, len(todo), backend)
            return _report(arguments, tasks, published, title)
        except KeyboardInterrupt:
            left = len(_missing(todo, False))
            print(
                f"torchqm: interrupted; {len(tasks) - left} of {len(tasks)} results are in {out}, the same command "
                "goes on from there",
                file=sys.stderr,
            )
            return 130


@contextmanager
def _backend(arguments: argparse.Namespace, todo: "Sequence[Task]") -> Iterator[tuple[_RunAll, dict[str, Any]]]:
    """What runs the tasks, and what ``run.json`` says of it."""
    if arguments.backend == "local" or not todo:
        jobs = arguments.jobs or usable_cores()
        yield partial(in_processes, jobs=jobs), {"name": arguments.backend, "workers": min(jobs, len(todo))}
        return
    root = [] if arguments.root.startswith("synthetic:") else [Path(arguments.root)]
    with connected(arguments.address, arguments.out, root) as cluster:
        plural = "" if cluster.most == 1 else "s"
        print(f"Dask cluster {arguments.address}: {cluster.most} worker{plural}, one pair at a time each")
        if cluster.threads > cluster.most:
            print(f"  of {cluster.threads} threads one each is used; 'dask worker --nworkers N --nthreads 1' uses N")
        about = {"name": "dask", "address": arguments.address, "workers": cluster.most}

        def run_all(work: Callable[[Any], Any], tasks: "Sequence[Task]") -> Iterator[tuple[int, Any]]:
            written = []
            for number, result in cluster.do(work, tasks, arguments.jobs):
                written += [] if isinstance(result, Failure) else [tasks[number].path]
                yield number, result
            cluster.see(written)
            about["workers"] = cluster.most

        yield run_all, about


def _plan(
    arguments: argparse.Namespace,
) -> tuple["ShapeSet", list[tuple[str, str]], "list[Task]", "list[PublishedRows]"]:
    """All that is to be done, checked before anything is run or written."""
    from torchqm.benchmark import Settings, choose_methods, plan_tasks
    from torchqm.benchmark.summary import read_published_rows
    from torchqm.data import choose_pairs, open_shapes
    from torchqm.spectral import cache_folder

    names = [name.strip() for name in arguments.methods.split(",") if name.strip()]
    cache = (cache_folder(arguments.cache) or arguments.out / "cache").absolute()
    settings = Settings(arguments.root, arguments.out, arguments.points, arguments.solver, cache)
    try:
        matchers, others = choose_methods(names)
        shapes = open_shapes(arguments.root)
        spec = arguments.pairs or ("published" if shapes.published_pairs() else "within-class")
        pairs = choose_pairs(shapes, spec)[: arguments.limit]
        published = [read_published_rows(shapes.root, name, pairs) for name in others]
        return shapes, pairs, plan_tasks(shapes, matchers, pairs, settings), published
    except (ValueError, FileNotFoundError) as error:  # a set, pair, truth or file that cannot be used
        raise UserError(str(error)) from error


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """The output folder, made and held: two runs in one folder would do everything twice."""
    from filelock import FileLock, Timeout

    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = FileLock(out / ".lock", timeout=0)
        lock.acquire()
    except Timeout as error:
        raise UserError(f"{out}: another run is writing there") from error
    except OSError as error:
        raise UserError(f"{out}: the output folder cannot be used ({error.strerror or error})") from error
    try:
        yield
    finally:
        lock.release()


def _missing(tasks: "Sequence[Task]", retry: bool) -> "list[Task]":
    from torchqm.benchmark.ledger import LedgerError, read_record

    try:
        records = [read_record(task.path, task.key) for task in tasks]
    except LedgerError as error:
        raise UserError(str(error)) from error
    return [
        task
        for task, record in zip(tasks, records, strict=True)
        if record is None or (retry and record["status"] == "failed")
    ]


def _forget(todo: "Sequence[Task]") -> None:
    """Remove the results of tasks that are to be done again; from now on a result that is there is one of this run."""
    from torchqm.benchmark.ledger import read_record

    for task in todo:
        if read_record(task.path, task.key) is not None:
            task.path.unlink()


def _do(todo: "Sequence[Task]", total: int, run_all: _RunAll, progress: Progress) -> None:
    """Run tasks and tell how far they are; the time left goes by the times of each method so far."""
    from torchqm.benchmark import run_task
    from torchqm.benchmark.run import fail_task

    there, kinds = total - len(todo), [(task.matcher.name, task.kind) for task in todo]
    left = {kind: kinds.count(kind) for kind in kinds}
    spent: dict[tuple[str, str], list[float]] = {}
    progress.listener(f"{there} of {total} results", -1.0, 0.0)
    clock = perf_counter()
    for count, (number, result) in enumerate(run_all(run_task, todo), 1):
        task, kind = todo[number], kinds[number]
        if isinstance(result, Failure):
            fail_task(task, result.reason)
        # With several workers a result comes every `seconds / workers`; only ratios matter for the share.
        seconds, clock = perf_counter() - clock, perf_counter()
        spent.setdefault(kind, []).append(seconds)
        left[kind] -= 1
        done = sum(map(sum, spent.values()))
        usual = done / count
        ahead = sum(n * (sum(spent[k]) / len(spent[k]) if k in spent else usual) for k, n in left.items())
        failed = isinstance(result, Failure) or result == "failed"
        share = done / (done + ahead) if done + ahead > 0 else 1.0
        progress.listener(f"{task.label}{' failed' if failed else ''}", seconds, share)
        progress.listener(f"{there + count} of {total} results", -1.0, share)


def _report(
    arguments: argparse.Namespace,
    tasks: "Sequence[Task]",
    published: "Sequence[PublishedRows]",
    title: str,
) -> int:
    """Write the tables, figures and the page."""
    from torchqm.benchmark import write_page, write_summary
    from torchqm.benchmark.ledger import LedgerError
    from torchqm.benchmark.page import draw_picture
    from torchqm.benchmark.runs import write_report

    out = arguments.out
    jobs = min(arguments.jobs or usable_cores(), usable_cores())

    def draw(pictures: "Sequence[Picture]") -> Iterator[tuple[int, Any]]:
        # A process takes seconds to start; for a few pictures this one is as quick.
        yield from in_processes(draw_picture, pictures, min(jobs, 1 + len(pictures) // 8))

    try:
        rows, files = write_summary(tasks, published, out, title)
        write_page(tasks, out, title, arguments.worst, draw)
    except LedgerError as error:
        raise UserError(str(error)) from error
    except ValueError as error:
        if str(error).startswith("rows:"):
            raise UserError(f"{out}: no result is there yet") from error
        raise
    write_report(out, as_plain(arguments))
    print((out / "table.md").read_text("utf-8"))
    failed = sum(bool(row.get("reason")) for row in rows)
    print(f"written: {', '.join(str(out / name) for name in (*FILES, *sorted(set(files) - {'csv', 'table'})))}")
    return 1 if failed else 0
