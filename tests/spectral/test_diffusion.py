"""torchqm.spectral.diffusion: heat flow, exact in the span of the basis."""

import torch
from references.shapes import basis_of, blob, icosphere

from torchqm.geometry import cotan_stiffness
from torchqm.spectral.diffusion import spectral_diffusion
from torchqm.testing import gradcheck64


def test_with_all_functions_it_is_the_matrix_exponential():
    mesh = icosphere(1)  # 42 vertices
    mass = mesh.vertex_areas
    stiffness = cotan_stiffness(mesh.verts, mesh.faces).to_dense()
    root = mass.sqrt()
    evals, vectors = torch.linalg.eigh(stiffness / root[:, None] / root)
    evecs = vectors / root[:, None]
    values = torch.randn(42, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    times = torch.tensor([0.05, 0.7], dtype=torch.float64)
    found = spectral_diffusion(values, mass, evals, evecs, times)
    for c in range(2):
        heat = torch.linalg.matrix_exp(-times[c] * stiffness / mass[:, None])
        torch.testing.assert_close(found[:, c], heat @ values[:, c], rtol=1e-9, atol=1e-12)


def test_eigenfunctions_decay_and_heat_is_kept():
    basis = basis_of(blob(1).mesh, 12)
    times = torch.linspace(0.0, 0.3, 12, dtype=torch.float64)
    found = spectral_diffusion(basis.evecs, basis.mass, basis.evals, basis.evecs, times)
    torch.testing.assert_close(found, basis.evecs * torch.exp(-basis.evals * times), rtol=1e-9, atol=1e-10)
    bump = torch.zeros(642, 12, dtype=torch.float64)
    bump[7] = 1.0
    spread = spectral_diffusion(bump, basis.mass, basis.evals, basis.evecs, times)
    torch.testing.assert_close(basis.mass @ spread, basis.mass @ bump, rtol=1e-8, atol=0)


def test_one_flow_after_the_other_takes_the_sum_of_times():
    basis = basis_of(blob(1).mesh, 12)
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(642, 3, dtype=torch.float64, generator=generator)
    a, b = torch.rand(2, 3, dtype=torch.float64, generator=generator)

    def flow(f, t):
        return spectral_diffusion(f, basis.mass, basis.evals, basis.evecs, t)

    torch.testing.assert_close(flow(flow(values, a), b), flow(values, a + b), rtol=1e-8, atol=1e-10)


def test_batches_and_vmap_give_what_each_shape_gives():
    bases = [basis_of(blob(order).mesh, 8) for order in (1, 2)]
    values = torch.randn(2, 642, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    times = torch.tensor([0.0, 0.01, 0.2], dtype=torch.float64)
    mass, evals, evecs = (torch.stack([getattr(b, name) for b in bases]) for name in ("mass", "evals", "evecs"))
    alone = torch.stack(
        [spectral_diffusion(f, b.mass, b.evals, b.evecs, times) for f, b in zip(values, bases, strict=True)]
    )
    torch.testing.assert_close(spectral_diffusion(values, mass, evals, evecs, times), alone)
    mapped = torch.func.vmap(spectral_diffusion, in_dims=(0, 0, 0, 0, None))(values, mass, evals, evecs, times)
    torch.testing.assert_close(mapped, alone)


def test_gradients():
    generator = torch.Generator().manual_seed(3)

    def random(*size):
        return torch.rand(*size, dtype=torch.float64, generator=generator)

    gradcheck64(spectral_diffusion, random(2, 5, 3), random(2, 5), random(2, 4), random(2, 5, 4), random(3))
