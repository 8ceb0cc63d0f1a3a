"""Two poses of a quadruped in different triangulations, which every matcher of a comparison is tried on."""

import pytest
import torch

from torchqm.data.synthetic import creature, exact_maps, symmetry_truth
from torchqm.geometry import distances
from torchqm.matching import prepare
from torchqm.matching.baselines import Given

K = 80


class Walkers:
    """Source, target (another pose, another triangulation), what could be given of them, and the error of a map."""

    def __init__(self):
        a, b = creature("quadruped", 1000, 0, 1), creature("quadruped", 1000, 0, 2, 1)
        self.x, self.y, self.rest = (prepare(c.mesh, K) for c in (a, b, creature("quadruped", 1000)))
        assert self.x.n_verts != self.y.n_verts
        symmetries = [symmetry_truth(c).nearest_vertices() for c in (a, b)]
        self.symmetry_x = symmetries[0]
        across = [_across(c.rest.verts, maps[1]) for c, maps in zip((a, b), symmetries, strict=True)]
        self.given = Given(*symmetries, *across, reference=self.rest)
        self.truth = exact_maps(a, b).nearest_vertices()
        self.at = self.x.samples[:100]
        self.rows = distances(self.y.mesh, self.truth[:, self.at].flatten()).reshape(2, 100, -1)

    def errors(self, p2p):
        """Mean distance / sqrt(area) from the direct and from the mirrored truth."""
        found = p2p[self.at]
        return torch.stack([rows[torch.arange(100), found].mean() for rows in self.rows])


def _across(verts, reflection):
    moved = verts - verts[reflection]
    return moved[:, int(moved.abs().mean(0).argmax())]


@pytest.fixture(scope="session")
def walkers():
    return Walkers()
