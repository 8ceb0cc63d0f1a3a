"""Matchers for tests of comparison runs; in a module that other processes can import."""

import os
import signal
import time
from dataclasses import dataclass

import torch

from torchqm.benchmark import run_task
from torchqm.matching.baselines import BaselineResult
from torchqm.matching.parameters import MatchError


@dataclass(frozen=True)
class Scripted:
    """Sends every vertex to the one of its id (modulo), unless the names of the shapes say otherwise.

    Args:
        fails: target that it refuses.
        log: file to which each pair is added.
        shift: added to the ids.
        wait: file to which the process that is first there writes its id, to be killed then.
        name: in tables.
        needs: as in the protocol.
    """

    fails: str = ""
    log: str = ""
    shift: int = 0
    wait: str = ""
    name: str = "scripted"
    needs: tuple[str, ...] = ()

    def match(self, x, y, given=None):
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{x.mesh.name} {y.mesh.name}\n")
        if self.wait and first(self.wait):
            time.sleep(600)
        if y.mesh.name == self.fails:
            raise MatchError("no map | <today>")
        maps = (torch.arange(x.n_verts) + self.shift)[None] % y.n_verts
        return BaselineResult(self.name, maps, ("direct",), {"all": 0.25}, ["a note"])


def first(mark: str) -> bool:
    """Whether this process is the first to come here; then its id is in the file."""
    try:
        with open(mark, "x") as file:
            file.write(str(os.getpid()))
    except FileExistsError:
        return False
    return True


def run_and_die(task) -> str:
    """As ``run_task``, but the process that wrote the sixth result dies before it can say so."""
    found = run_task(task)
    if len(list(task.path.parent.glob("[!.]*.json"))) == 6 and first(f"{task.matcher.log}.died"):
        os.kill(os.getpid(), signal.SIGKILL)
    return found
