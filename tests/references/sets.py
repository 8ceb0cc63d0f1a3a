"""Sets of shapes without files: names alone, and small meshes with exact groups and truths."""

import torch
from references import shapes

from torchqm.data.base import ShapeSet, Truth, TruthError


class Named(ShapeSet):
    """Shapes that are only names; the class is the name without its number."""

    root, layout, recognised = "nowhere", "plain", ()

    def __init__(self, names, published=(), parts=None):
        self._names, self._published, self._parts = list(names), list(published), parts

    @property
    def names(self):
        return self._names

    def shape_class(self, name):
        return name.rstrip("0123456789-")

    def path(self, name):
        return None

    def truth(self, first, second):
        raise TruthError(f"{self.root}: no truth from {first} to {second}")

    def problems(self):
        return []

    def published_pairs(self):
        return self._published

    def split(self):
        return self._parts


class Blobs(Named):
    """A blob with one reflection and its renumbered copy, one with 8 symmetries, a rectangle with an unknown group."""

    def __init__(self):
        super().__init__(["two-0", "two-1", "eight-0", "flat-0"])
        self.copy = shapes.renumbered(shapes.blob(2, 2), 8)
        self._shapes = {"two-0": shapes.blob(2, 2), "two-1": self.copy.shape, "eight-0": shapes.blob(8, 1)}
        self.meshes_asked = []

    def mesh(self, name):
        self.require(name)
        self.meshes_asked.append(name)
        return self._shapes[name].mesh if name in self._shapes else shapes.grid(5, 4, 3.0, 2.0)

    def symmetry(self, name):
        return self._shapes[name].group if name in self._shapes else None

    def truth(self, first, second):
        n = self._shapes["two-0"].mesh.n_verts
        maps = {
            ("two-0", "two-1"): self.copy.p2p_xy,
            ("two-1", "two-0"): self.copy.p2p_yx,
            (first, first): torch.arange(self.mesh(first).n_verts),
        }
        if (first, second) not in maps:
            return super().truth(first, second)
        return Truth(torch.arange(n if first != second else len(maps[first, second])), maps[first, second], "by hand")
