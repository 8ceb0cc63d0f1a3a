"""The suite's own set-up: annotations are checked, one thread, exact groups on the shared shapes."""

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


def test_results_are_checked_against_the_sizes_of_the_arguments():
    @jaxtyped(typechecker=checked)
    def head(values: Float[Tensor, "V C"], n: int) -> Float[Tensor, "V"]:
        return values[:n, 0]

    assert head(torch.zeros(3, 2), 3).shape == (3,)
    with pytest.raises(TypeCheckError, match="return value"):
        head(torch.zeros(3, 2), 2)
    with pytest.raises(TypeCheckError, match="parameters"):
        head(torch.zeros(3), 2)
    with pytest.raises(TypeCheckError, match="parameters"):
        head(torch.zeros(3, 2), "3")


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
