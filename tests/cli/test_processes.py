"""torchqm.cli.processes: every task has its result or its reason, whatever becomes of the processes."""

import os
import signal
import subprocess
import sys
import time

import pytest
from references.work import obey

from torchqm.cli.processes import Failure, in_processes, usable_cores


@pytest.mark.parametrize("jobs", [1, 2])
def test_failures_are_told_and_the_rest_is_done(jobs):
    tasks = ["a", "fail x.off: no\nmesh", "b", "break it", "fail"]
    results = dict(in_processes(obey, tasks, jobs))
    assert results == {
        0: "a done",
        1: Failure("x.off: no mesh"),
        2: "b done",
        3: Failure("RuntimeError: it"),
        4: Failure("ValueError: "),
    }


def test_no_tasks_and_more_processes_than_tasks():
    assert list(in_processes(obey, [], 4)) == []
    assert dict(in_processes(obey, ["a", "b"], 50)) == {0: "a done", 1: "b done"}


def test_a_dying_process_is_a_failure_of_its_own_task_alone(tmp_path):
    # What dies once is first: else it may be lost before it began, beside another, and then dies where it is alone.
    tasks = [f"once {tmp_path / 'mark'}", "a", "die", "b", "c", "die", "d"]
    results = dict(in_processes(obey, tasks, 2))
    dead = Failure("its process died (out of memory, or killed)")
    assert [results[number] for number in range(7)] == [
        f"{tasks[0]} done",
        "a done",
        dead,
        "b done",
        "c done",
        dead,
        "d done",
    ]


def test_one_thread_each(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    assert set(dict(in_processes(obey, ["threads"] * 3, 2)).values()) == {"1"}
    assert os.environ["OMP_NUM_THREADS"] == "8"


def test_usable_cores():
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


def wait_until(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rsplit(")", 1)[1].split()[0] != "Z"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_no_process_outlives_the_one_that_started_it(tmp_path, how):
    marks = [tmp_path / "a", tmp_path / "b"]
    code = (
        "import signal, sys\nfrom references.work import obey\nfrom torchqm.cli.processes import in_processes\n"
        # A shell's background jobs, and what they start, ignore Ctrl-C.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "if __name__ == '__main__':\n    list(in_processes(obey, [f'hang {mark}' for mark in sys.argv[1:]], 2))\n"
    )
    tests = os.path.dirname(os.path.dirname(__file__))
    run = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, marks)],
        env=os.environ | {"PYTHONPATH": tests},
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: all(mark.exists() and mark.read_text() for mark in marks))
        pids = [int(mark.read_text()) for mark in marks]
        assert all(alive(pid) for pid in pids)
        run.send_signal(how)  # to it alone
        run.wait(30)
        wait_until(lambda: not any(alive(pid) for pid in pids))
    finally:
        run.kill()
        run.wait()
