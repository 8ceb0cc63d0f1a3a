"""The suite's own set-up: annotations are checked, one thread, exact groups on the shared shapes."""

from collections.abc import Iterator

import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped
from references.checker import checked
from torch import Tensor

from torchqm.geometry import inspect_mesh
from torchqm.spectral import SpectralBasis, cluster_end
from torchqm.symmetry import even_part


def test_annotations_are_checked(mirror_blob):
    with pytest.raises(TypeCheckError):
        even_part(torch.zeros(642, dtype=torch.float64), mirror_blob.group)  # (V,) where (V, C) is annotated
    with pytest.raises(TypeCheckError):
        SpectralBasis(torch.zeros(2), torch.zeros(5, 3), torch.zeros(5))
    assert cluster_end(torch.tensor([1.0, 2.0]), 2, rtol=0) == 2  # an int is a float


class TestChecker:
    """What each function of the package is checked for; the decorator is the one that the import hook puts there."""

    @staticmethod
    @jaxtyped(typechecker=checked)
    def head(values: Float[Tensor, "V C"], n: "int" = 3, more: "Unknown | None" = None) -> 'Float[Tensor, "V"]':
        return values[:n, 0]

    def test_what_is_right_passes(self):
        assert self.head(torch.zeros(3, 2)).shape == self.head(values=torch.zeros(3, 1), n=3, more=5).shape == (3,)

    @pytest.mark.parametrize(
        ("arguments", "about"),
        [
            ((torch.zeros(3, 2), 2), "return"),  # not the size that the argument has
            ((torch.zeros(3),), "parameter values"),
            ((torch.zeros(3, 2, dtype=torch.int64),), "parameter values"),
            ((torch.zeros(3, 2), "3"), "parameter n"),  # an annotation that is a string
        ],
    )
    def test_what_is_wrong_is_refused(self, arguments, about):
        with pytest.raises(TypeCheckError, match=about):
            self.head(*arguments)

    def test_sizes_are_those_of_one_call(self):
        """Neither those of the call before, nor those of the function that calls."""

        @jaxtyped(typechecker=checked)
        def outer(values: Float[Tensor, "V C"]) -> Float[Tensor, "V"]:
            return self.head(torch.cat([values, values]), 6)[: len(values)]

        assert outer(torch.zeros(3, 2)).shape == (3,)
        assert outer(torch.zeros(4, 1)[:3]).shape == (3,)

    def test_two_arguments_have_one_size(self):
        @jaxtyped(typechecker=checked)
        def add(one: Float[Tensor, " V"], other: Float[Tensor, " V"]) -> Float[Tensor, " V"]:
            return one + other

        with pytest.raises(TypeCheckError, match="parameter other"):
            add(torch.zeros(3), torch.zeros(1))

    def test_generators_are_checked_when_they_are_called(self):
        @jaxtyped(typechecker=checked)
        def count(n: int) -> Iterator[int]:
            yield from range(n)

        assert list(count(2)) == [0, 1]
        with pytest.raises(TypeCheckError):
            count("2")

    def test_a_value_error_is_not_touched(self):
        @jaxtyped(typechecker=checked)
        def fail(n: int) -> int:
            raise ValueError(n)

        with pytest.raises(ValueError, match="3"):
            fail(3)


def test_one_thread():
    assert torch.get_num_threads() == 1


def test_shapes_are_what_they_say(blob, box, prism, sphere, rectangle):
    assert (blob.group.n_verts, box.group.order, prism.group.order) == (642, 8, 16)
    for mesh in (blob.mesh, box.mesh, prism.mesh, sphere):
        report = inspect_mesh(mesh)
        assert report.warnings == []
        assert bool(((mesh.verts[mesh.faces].mean(1) * mesh.face_normals).sum(1) > 0).all())  # outward
    for mesh, group in (blob, box, prism):  # every element maps faces to faces
        faces = {frozenset(f) for f in mesh.faces.tolist()}
        for element in group.maps:
            assert {frozenset(f) for f in element[mesh.faces].tolist()} == faces
    assert rectangle.area == pytest.approx(1.5)
