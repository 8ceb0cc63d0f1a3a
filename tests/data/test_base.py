"""What all sets offer: truths, and mirrored ones."""

import pytest
import torch

from torchqm.data.base import ShapeSet, Truth
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.symmetry import SymmetryGroup


class Swap(ShapeSet):
    """Two shapes of four vertices with a truth of three points; the reflection exchanges 0, 1 and 2, 3."""

    root, layout = "made", "made"

    def __init__(self, points, known=None):
        self.recognised = []
        self._points, self._known = points, known

    @property
    def names(self):
        return ["b1", "a10", "a2"]

    def shape_class(self, name):
        return name.rstrip("0123456789")

    def path(self, name):
        return None

    def n_verts(self, name):
        return 4

    def truth(self, first, second):
        return Truth(torch.tensor([3, 0, 1]), self._points, "made")

    def symmetry(self, name):
        return SymmetryGroup.from_reflection(torch.tensor([1, 0, 3, 2])) if self._known is None else None

    def symmetry_truth(self, name):
        return super().symmetry_truth(name) if self._known is None else self._known

    def problems(self):
        return []


def test_lengths_must_agree():
    with pytest.raises(ValueError, match="points: 1 given for 2 vertices in 'at'"):
        Truth(torch.tensor([0, 1]), torch.tensor([0]), "x")


def test_a_point_inside_a_face_is_nearest_to_its_heaviest_corner():
    points = SurfacePoints(torch.tensor([[4, 5, 6], [7, 8, 9]]), torch.tensor([[0.2, 0.5, 0.3], [0.0, 0.0, 1.0]]))
    truth = Truth(torch.tensor([0, 1]), points, "x")
    assert truth.vertices.tolist() == [5, 9]
    assert len(truth) == 2


def test_mirrored_truth_of_vertices_and_of_points():
    mirrored = Swap(torch.tensor([0, 2, 2])).mirrored_truth("a2", "b1")
    assert (mirrored.at.tolist(), mirrored.points.tolist()) == ([3, 0, 1], [1, 3, 3])
    assert mirrored.source == "made, then symmetry of the whole shape"
    points = SurfacePoints(torch.tensor([[0, 1, 2]] * 3), torch.tensor([[0.5, 0.3, 0.2]] * 3))
    mirrored = Swap(points).mirrored_truth("a2", "b1")
    assert mirrored.points.corners.tolist() == [[1, 0, 3]] * 3
    assert torch.equal(mirrored.points.bary, points.bary)


def test_mirrored_truth_is_only_where_the_reflection_is_known():
    known = Truth(torch.tensor([2, 1]), torch.tensor([3, 0]), "landmarks")
    mirrored = Swap(torch.tensor([0, 2, 1]), known).mirrored_truth("a2", "b1")
    assert (mirrored.at.tolist(), mirrored.points.tolist()) == ([0, 1], [3, 0])
    assert Swap(torch.tensor([0, 3, 0]), known).mirrored_truth("a2", "b1") is None
    points = SurfacePoints(torch.tensor([[0, 1, 2], [2, 1, 2], [1, 1, 2]]), torch.tensor([[0.5, 0.3, 0.2]] * 3))
    assert Swap(points, known).mirrored_truth("a2", "b1").at.tolist() == [0, 1]


def test_names_and_classes():
    shapes = Swap(torch.tensor([0, 1, 2]))
    assert shapes.classes == ["a", "b"]
    assert len(shapes) == 3
    shapes.require("a2", "b1")
    with pytest.raises(ValueError, match="made: no shape 'c'; shapes here: b1, a10, a2"):
        shapes.require("a2", "c")
    assert repr(shapes) == "Swap('made': made, 3 shapes)"
    assert shapes.published_pairs() == []
    assert shapes.split() is None
