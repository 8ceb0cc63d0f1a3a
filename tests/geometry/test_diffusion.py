"""torchqm.geometry.diffusion: eigenfunctions are damped by their frequency, means stay."""

import pytest
import torch
from references.shapes import icosphere

from torchqm.geometry import Mesh
from torchqm.geometry.diffusion import diffused
from torchqm.spectral import mesh_basis


@pytest.fixture(scope="module")
def sphere():
    return icosphere(3)


def test_an_eigenfunction_is_damped_by_its_frequency(sphere):
    basis = mesh_basis(sphere, 20, kind="cotan")
    time = 0.05
    found = diffused(sphere, basis.evecs, time, rtol=1e-12)
    torch.testing.assert_close(found, basis.evecs / (1 + time * basis.evals), atol=1e-8, rtol=0)


def test_the_integral_stays_and_time_zero_changes_nothing(sphere):
    values = torch.randn(sphere.n_verts, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    after = diffused(sphere, values, 0.3, rtol=1e-12)
    torch.testing.assert_close(sphere.vertex_areas @ after, sphere.vertex_areas @ values, atol=1e-9, rtol=0)
    assert float(after.var()) < 0.1 * float(values.var())
    torch.testing.assert_close(diffused(sphere, values, 0.0), values)


def test_a_loose_vertex_keeps_its_value(sphere):
    loose = Mesh(torch.cat([sphere.verts, torch.ones(1, 3, dtype=torch.float64)]), sphere.faces)
    values = torch.arange(loose.n_verts, dtype=torch.float64)[:, None]
    found = diffused(loose, values, 0.1, rtol=1e-10)
    assert float(found[-1]) == pytest.approx(float(values[-1]))
    torch.testing.assert_close(found[:-1], diffused(sphere, values[:-1], 0.1, rtol=1e-10), atol=1e-5, rtol=0)


def test_time_must_not_be_negative(sphere):
    with pytest.raises(ValueError, match="time=-1"):
        diffused(sphere, torch.ones(sphere.n_verts, 1, dtype=torch.float64), -1.0)
