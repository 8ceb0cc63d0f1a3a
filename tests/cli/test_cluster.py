"""torchqm.cli.cluster: two workers, of which one or both die: nothing is lost, nothing is done twice."""

import csv
import json
import pickle
import sys
from collections import Counter
from concurrent.futures import CancelledError
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace

import dask
import distributed
import pytest
from references import shapes
from references.matchers import Scripted, run_and_die
from references.work import killing, obey

from torchqm import benchmark
from torchqm.cli import cluster as module
from torchqm.cli.cluster import connected
from torchqm.cli.console import Progress, UserError
from torchqm.cli.main import main
from torchqm.cli.processes import Failure
from torchqm.evaluate import report
from torchqm.geometry import save_mesh
from torchqm.matching.baselines import MATCHERS


@contextmanager
def workers(n):
    with distributed.LocalCluster(
        n_workers=n, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as local:
        yield local


@pytest.fixture(scope="module")
def local():
    # LocalCluster gives a worker up for lost that died 15 s ago and is down again; with 'dask worker' nobody does.
    options = {"distributed.scheduler.allowed-failures": 1, "distributed.deploy.lost-worker-timeout": "1h"}
    with dask.config.set(options), workers(2) as found:
        yield found


@pytest.fixture
def address(local):
    """Of a scheduler with two workers, those that an earlier test killed being back."""
    local.wait_for_workers(2, timeout=60)
    return local.scheduler_address


@pytest.fixture
def scripted(monkeypatch, tmp_path):
    """Puts a matcher of the tests under the name ``scripted``; gives the pairs that it was asked for."""
    log = tmp_path / "log.txt"
    monkeypatch.setattr(report, "_draw", lambda methods, path, title: path)

    def put(**options):
        monkeypatch.setitem(MATCHERS, "scripted", Scripted(log=str(log), **options))
        return lambda: Counter(log.read_text().splitlines())

    return put


@pytest.fixture
def root(tmp_path):
    """Three poses of a shape."""
    (tmp_path / "set").mkdir()
    for number in range(3):
        save_mesh(shapes.blob(2, 2).mesh, tmp_path / "set" / f"a{number}.off")
    return tmp_path / "set"


def bench(root, out, address, *words):
    words = ["--methods", "scripted", "--points", "10", "--worst", "0", *words]
    return main(
        ["benchmark", str(root), "--pairs", "all", "--out", str(out), "--backend", "dask", "--address", address, *words]
    )


# Workers load torch for a run; so first those that leave them alive.


def test_a_failed_pair_is_run_again_where_that_is_wanted(tmp_path, address, root, scripted):
    out = tmp_path / "out"
    pairs = scripted(fails="a1")
    for words, status, times in (([], 1, 1), ([], 1, 1), (["--retry"], 1, 2)):
        assert bench(root, out, address, "--limit", "2", *words) == status
        assert pairs() == {"a0 a1": times, "a0 a2": 1}


def test_an_interruption_takes_back_what_waits(tmp_path, address, root, scripted, monkeypatch, capsys):
    pairs = scripted()

    def interrupt(self, name, seconds, share):
        if seconds >= 0:  # of the first result
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "listener", interrupt)
        assert bench(root, tmp_path / "out", address, "--jobs", "1") == 130
    assert "interrupted; 1 of 6 results are in" in capsys.readouterr().err
    assert sum(pairs().values()) == 1
    assert bench(root, tmp_path / "out", address) == 0
    assert sorted(pairs().values()) == [1] * 6


def test_a_run_that_loses_workers_has_every_result_once(tmp_path, address, root, scripted, monkeypatch, capsys):
    out, mark = tmp_path / "out", tmp_path / "mark"
    pairs = scripted(wait=str(mark))
    monkeypatch.setattr(benchmark, "run_task", run_and_die)
    monkeypatch.chdir(tmp_path)
    with killing(mark):
        assert bench("set", "out", address) == 0  # relative: workers have another working folder
    assert "2 workers" in capsys.readouterr().out
    done = {path: json.loads(path.read_text()) for path in out.glob("results/*/*.json")}
    assert len(done) == 6
    with (out / "pairs.csv").open() as file:
        rows = [(row["source"], row["target"], row["plain_mean"]) for row in csv.DictReader(file)]
    assert sorted(rows) == sorted((r["source"], r["target"], "0.0") for r in done.values())
    asked = pairs()
    # Only the pair whose worker was killed in the middle was begun again, not the one that was written but not told.
    assert sorted(asked.values()) == [1, 1, 1, 1, 1, 2]
    assert Path(f"{tmp_path}/log.txt.died").exists()
    assert json.loads((out / "run.json").read_text())["runs"][-1]["backend"] == {
        "name": "dask",
        "address": address,
        "workers": 2,
    }
    before = {path: path.stat().st_mtime_ns for path in done}
    assert bench(root, out, "tcp://127.0.0.1:1") == 0  # nothing to do: no cluster is needed
    assert (before, pairs()) == ({path: path.stat().st_mtime_ns for path in done}, asked)


def test_a_killed_worker_loses_nothing_and_the_others_go_on(tmp_path, address):
    log, mark = tmp_path / "log.txt", tmp_path / "mark"
    tasks = [f"wait {mark}", *(f"note {log} {number}" for number in range(6)), "fail x.off: no\nmesh", "threads"]
    with killing(mark), connected(address, tmp_path) as cluster:
        results = list(cluster.do(obey, tasks))
    assert dict(results) == {
        **{number: f"{tasks[number]} done" for number in range(7)},
        7: Failure("x.off: no mesh"),
        8: "1",
    }
    assert len(results) == len(tasks)
    assert sorted(log.read_text().split()) == list("012345")
    assert [path.name for path in tmp_path.glob(".probe*")] == []


def test_a_task_that_kills_its_workers_is_a_failure_and_the_others_are_done(tmp_path, address):
    log = tmp_path / "log.txt"
    tasks = ["die", *(f"note {log} {number}" for number in range(4))]
    with connected(address, tmp_path) as cluster:
        results = dict(cluster.do(obey, tasks))
    dead = results.pop(0)
    assert isinstance(dead, Failure)
    assert dead.reason.startswith("each worker that took it died (out of memory, or killed), the last tcp://127.0.0.1:")
    assert results == {number: f"{tasks[number]} done" for number in range(1, 5)}
    assert set(log.read_text().split()) == set("0123")


def test_what_a_worker_cannot_load_is_a_failure(tmp_path, address, monkeypatch):
    here = ModuleType("only_here")
    exec("def work(task):\n    return task", vars(here))  # Dask itself would end the worker that cannot load it
    monkeypatch.setitem(sys.modules, "only_here", here)
    with connected(address, tmp_path) as cluster:
        results = dict(cluster.do(here.work, ["a", "b"]))
    assert results == dict.fromkeys(range(2), Failure("ModuleNotFoundError: No module named 'only_here'"))


def test_of_a_worker_of_several_threads_one_is_used(tmp_path, root, scripted, capsys):
    scripted()
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=":0", silence_logs=50
    ) as local:
        assert bench(root, tmp_path / "out", local.scheduler_address) == 0
        text = capsys.readouterr().out
        with connected(local.scheduler_address, tmp_path) as cluster:
            together = dict(cluster.do(obey, [f"alone {tmp_path / 'mark'}"] * 4, jobs=4))
            what = pickle.dumps((obey, f"alone {tmp_path / 'mark'}"))
            again = [cluster.client.submit(module._one, what, pure=False) for _ in range(4)]
            assert [future.result() for future in again] == [*together.values()]
    assert set(together.values()) == {f"alone {tmp_path / 'mark'} done"}
    assert "1 worker, one pair at a time each\n  of 2 threads one each is used" in text


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="uses /proc")
def test_a_worker_with_other_files_is_named(tmp_path, address, monkeypatch):
    own = Path("/proc/self/cwd")  # another folder for each process
    monkeypatch.chdir(tmp_path)
    for folder, needed, text in (
        (own, [], "does not see what is in /proc/self/cwd; all machines must share"),
        (tmp_path, [tmp_path, own / "absent"], "does not see /proc/self/cwd/absent; all machines"),
    ):
        with (
            pytest.raises(UserError, match=f"^{address}: worker tcp://127.0.0.1:.* {text}"),
            connected(address, folder, needed),
        ):
            pass
    assert list(tmp_path.iterdir()) == []


def test_where_a_worker_cannot_write_or_writes_elsewhere(tmp_path, address, monkeypatch):
    probe = tmp_path / ".probe"
    probe.write_text("")
    answer = module._look(probe, [tmp_path])
    assert (answer.parent, answer.read_text()) == (tmp_path, "")

    def write_text(self, text):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "write_text", write_text)
    assert module._look(probe, []) == f"cannot write to {tmp_path} (Permission denied)"
    monkeypatch.undo()
    monkeypatch.setattr(Path, "exists", lambda self: ".probe" not in self.name)
    with pytest.raises(UserError, match="of its own; all machines must share"), connected(address, tmp_path):
        pass


def test_a_worker_with_another_version_is_named(tmp_path, address, monkeypatch):
    monkeypatch.setattr(module, "__version__", "9.9")
    with (
        pytest.raises(UserError, match=r"worker tcp://127.0.0.1:.* has torchqm .*, this machine 9\.9; all need"),
        connected(address, tmp_path),
    ):
        pass


def test_files_that_never_come_are_said(tmp_path, monkeypatch, address):
    monkeypatch.setattr(module, "UNSEEN", 0.0)
    monkeypatch.setattr(module, "_TICK", 0.01)
    with connected(address, tmp_path) as cluster:
        cluster.see([tmp_path])
        with pytest.raises(UserError, match=r"absent: a worker wrote it, but it is not seen here"):
            cluster.see([tmp_path, tmp_path / "absent"])


def test_what_the_client_makes_of_an_ending_scheduler(tmp_path):
    client = SimpleNamespace(status="running")
    cluster = module.Cluster(client, "tcp://a:1", tmp_path, [])

    def end(status, error):
        client.status = "running"
        with cluster._kept():
            client.status = status
            raise error

    for status, error in (
        ("running", OSError("reset")),
        ("running", CancelledError()),
        ("closed", AttributeError("'NoneType' object has no attribute 'ncores'")),
    ):
        with pytest.raises(UserError, match=r"tcp://a:1: .* what is done is kept, the same command goes on"):
            end(status, error)
    for error in (AttributeError("a bug"), TimeoutError()):
        with pytest.raises(type(error)):
            end("running", error)


def test_no_worker_none_left_and_no_scheduler_left(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "CONNECT", 0.5)
    monkeypatch.setattr(module, "PATIENCE", 0.1)
    monkeypatch.setattr(module, "_TICK", 0.1)
    with workers(0) as local:
        address = local.scheduler_address
        with pytest.raises(UserError, match="has no worker"), connected(address, tmp_path):
            pass
        client = distributed.Client(address, set_as_default=False)
        cluster = module.Cluster(client, address, tmp_path / "probe", [])
        with pytest.raises(UserError, match="no worker is left; what is done is kept"):
            list(cluster.do(obey, ["a"]))
    with pytest.raises(UserError, match="what is done is kept, the same command goes on from there"):
        list(cluster.do(obey, ["a"]))
    client.close()
