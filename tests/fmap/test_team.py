"""torchqm.fmap.team: interrupts, and systems without threads, leave all as it was. See also test_threads."""

import subprocess
import sys
from threading import Event, Thread

import pytest
import torch

from torchqm.fmap import team as module
from torchqm.fmap import threads
from torchqm.fmap.team import Team
from torchqm.fmap.threads import in_parallel, one_thread


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_where_no_thread_can_be_started_the_caller_does_it_all(two_threads, monkeypatch):
    class Unstartable(Thread):
        def start(self):
            raise RuntimeError("can't start new thread")

    monkeypatch.setattr(module, "Thread", Unstartable)
    with one_thread():
        assert in_parallel([lambda: 1, lambda: 2, lambda: 3]) == [1, 2, 3]
    assert torch.get_num_threads() == 2
    assert threads._BLAS._users == 0


def test_an_interrupt_of_a_task_comes_before_another_tasks_error(two_threads):
    failed = Event()

    def interrupt():
        failed.wait(20)
        raise KeyboardInterrupt

    def fail():
        try:
            raise ValueError("a")
        finally:
            failed.set()

    with pytest.raises(KeyboardInterrupt), one_thread():
        in_parallel([interrupt, fail])


def test_a_close_that_fails_leaves_the_threads_as_they_were(two_threads, monkeypatch):
    def close(self, wait):
        raise KeyboardInterrupt

    monkeypatch.setattr(Team, "close", close)
    with pytest.raises(KeyboardInterrupt), one_thread():
        pass
    assert torch.get_num_threads() == 2
    assert threads._BLAS._users == 0
    assert threads._TEAM.get() is None


def test_after_an_interrupt_nobody_waits_for_a_helper_at_a_long_task():
    """Interrupted again and again at short tasks, too: the lock may be taken or not at that moment."""
    code = """
import os, signal, sys, time, torch
from threading import Event, Thread
from torchqm.fmap import threads
from torchqm.fmap.threads import in_parallel, one_thread
torch.set_num_threads(2)
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell in the background has taken away
stop, busy = Event(), Event()
def long_one():
    busy.set(); stop.wait(20)
def mine():
    busy.wait(20); os.kill(os.getpid(), signal.SIGINT); time.sleep(5)
begin = time.monotonic()
try:
    with one_thread():
        in_parallel([mine, long_one])
except KeyboardInterrupt:
    pass
stop.set()
assert time.monotonic() - begin < 10, 'waited'
for _ in range(40):
    def interrupt():
        time.sleep(0.02); os.kill(os.getpid(), signal.SIGINT)
    sender = Thread(target=interrupt)
    try:
        sender.start()
        with one_thread():
            while True:
                in_parallel([lambda: None] * 4)
    except KeyboardInterrupt:
        pass
    sender.join()
print(torch.get_num_threads(), threads._BLAS._users, threads._TEAM.get())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout == "2 0 None\n", done.stderr
