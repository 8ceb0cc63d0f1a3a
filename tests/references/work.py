"""Work for other processes: it does as it is told, also to fail, to die, or to take long."""

import os
import signal
import time
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
    if word == "threads":
        return os.environ["OMP_NUM_THREADS"]
    return f"{task} done"
