"""Work for other processes: it does as it is told, also to fail, to die, or to take long; and what kills them."""

import os
import signal
import threading
import time
from contextlib import contextmanager
from pathlib import Path


def obey(task: str) -> str:
    word, _, rest = task.partition(" ")
    if word == "fail":
        raise ValueError(rest)
    if word == "break":
        raise RuntimeError(rest)
    if word == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "once" and not Path(rest).exists():
        Path(rest).write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "hang":
        Path(rest).write_text(str(os.getpid()))
        time.sleep(600)
    if word == "wait" and not Path(rest).exists():
        Path(rest).write_text(str(os.getpid()))
        time.sleep(600)
    if word == "note":
        log, _, line = rest.partition(" ")
        with open(log, "a") as file:
            file.write(f"{line}\n")
    if word == "alone":  # fails beside another of its kind
        Path(rest).touch(exist_ok=False)
        time.sleep(0.01)
        Path(rest).unlink()
    if word == "threads":
        return os.environ["OMP_NUM_THREADS"]
    return f"{task} done"


@contextmanager
def killing(mark: Path):
    """Kills the process whose id appears in a file, while the body runs; the body must need it."""
    stop = threading.Event()

    def watch():
        while not stop.wait(0.02):
            if mark.exists() and mark.read_text():
                os.kill(int(mark.read_text()), signal.SIGKILL)
                return

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
