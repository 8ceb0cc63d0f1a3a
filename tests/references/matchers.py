"""Matchers for tests of comparison runs; in a module that other processes can import."""

from dataclasses import dataclass

import torch

from torchqm.matching.baselines import BaselineResult
from torchqm.matching.parameters import MatchError


@dataclass(frozen=True)
class Scripted:
    """Sends every vertex to the one of its id (modulo), unless the names of the shapes say otherwise.

    Args:
        fails: target that it refuses.
        log: file to which each pair is added.
        shift: added to the ids.
        name: in tables.
        needs: as in the protocol.
    """

    fails: str = ""
    log: str = ""
    shift: int = 0
    name: str = "scripted"
    needs: tuple[str, ...] = ()

    def match(self, x, y, given=None):
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{x.mesh.name} {y.mesh.name}\n")
        if y.mesh.name == self.fails:
            raise MatchError("no map | <today>")
        maps = (torch.arange(x.n_verts) + self.shift)[None] % y.n_verts
        return BaselineResult(self.name, maps, ("direct",), {"all": 0.25}, ["a note"])
