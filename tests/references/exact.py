"""Creatures at rest with their exact symmetries as functional maps."""

import torch

from torchqm.data.synthetic import creature
from torchqm.fmap import nearest_isometry, p2p_to_fmap
from torchqm.matching import nearest_involution, prepare
from torchqm.matching.proposals import Judge, Proposal, correlation

K = 98
"""Where no cluster of the octopus's eigenvalues is cut."""


class Exact:
    """A creature at rest with the functional maps of its group: ``C delta_x = delta_g(x)``."""

    def __init__(self, kind):
        self.body = creature(kind, 1000)
        self.shape = prepare(self.body.mesh, K)
        self.judge = Judge(self.shape)
        self.group = self.body.base_group
        self.orientation = self.body.orientation.tolist()
        self.proposals = [self.proposal(g, o) for g, o in zip(self.group, self.orientation, strict=True)]
        self.fmaps = [proposal.fmap for proposal in self.proposals]

    def proposal(self, images, orientation, score=None):
        fmap = p2p_to_fmap(images.argsort(), self.shape.basis, self.shape.basis)
        undone = torch.equal(images[images], torch.arange(len(images)))
        fmap = nearest_involution(fmap) if undone else nearest_isometry(fmap)
        return Proposal(fmap, orientation, undone, self.judge.score(fmap, orientation) if score is None else score)

    def order(self, g):
        element, power, n = self.group[g], self.group[g], 1
        while not torch.equal(power, self.group[0]):
            power, n = element[power], n + 1
        return n

    def product(self, g, h):
        """Number of ``g o h`` in the true group."""
        wanted = self.group[g][self.group[h]]
        return next(i for i, element in enumerate(self.group) if torch.equal(element, wanted))

    def reflections(self):
        return [g for g, o in enumerate(self.orientation) if o < 0]

    def numbers(self, found):
        """Which true element each one of a group is."""
        near = torch.tensor([[correlation(e.fmap, p.fmap) for p in self.proposals] for e in found.elements])
        assert float(near.amax(1).min()) > 0.95
        return near.argmax(1).tolist()

    def half(self, g, axis, score=None):
        """A reflection on one half of the body, the identity on the other: what mirrors the arms and not the legs."""
        verts = self.shape.mesh.verts
        side = verts[:, axis] > (verts[:, axis] * self.shape.basis.mass).sum()
        assert torch.equal(side, side[self.group[g]])
        images = torch.where(side, self.group[g], torch.arange(len(side)))
        assert 0.2 < float((images != self.group[g]).double().mean()) < 0.8
        return self.proposal(images, -1, score)
