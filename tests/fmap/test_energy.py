"""torchqm.fmap.energy: the sums written out, and when they vanish."""

import pytest
import torch
from references.shapes import basis_of, renumbered

from torchqm.fmap import (
    commutativity_energy,
    commutativity_weights,
    descriptor_energy,
    orthogonality_energy,
    p2p_to_fmap,
)
from torchqm.spectral import wave_energies, wave_kernel_signature


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_descriptor_energy_is_the_sum():
    fmap, f, g = noise(3, 4), noise(4, 5), noise(3, 5)
    slow = sum(float((fmap @ f[:, s] - g[:, s]).norm() ** 2) for s in range(5))
    assert float(descriptor_energy(fmap, f, g)) == pytest.approx(slow)


def test_commutativity_energy_is_the_norm_of_the_commutator():
    fmap, mu, lam = noise(3, 4), noise(4, seed=1).abs(), noise(3, seed=2).abs()
    slow = sum(float(fmap[i, j]) ** 2 * float(lam[i] - mu[j]) ** 2 for i in range(3) for j in range(4))
    commutator = fmap @ torch.diag(mu) - torch.diag(lam) @ fmap
    assert float(commutativity_energy(fmap, mu, lam)) == pytest.approx(slow)
    assert float(commutator.square().sum()) == pytest.approx(slow)
    assert commutativity_weights(mu, lam)[2, 1] == (lam[2] - mu[1]) ** 2


def test_orthogonality_energy_looks_at_the_smaller_side():
    left, _, right = torch.linalg.svd(noise(5, 3), full_matrices=False)
    for fmap in (left @ right, (left @ right).T):
        assert float(orthogonality_energy(fmap)) == pytest.approx(0, abs=1e-24)
    assert float(orthogonality_energy(2 * left @ right)) == pytest.approx(3 * 9)
    assert float(orthogonality_energy((2 * left @ right).T)) == pytest.approx(3 * 9)
    assert float(orthogonality_energy(torch.zeros(2, 2))) == 2


@pytest.mark.parametrize(("kx", "ky"), [(4, 3), (3, 4)])
def test_batches_and_padding(kx, ky):
    fmap, f, g = noise(5, ky, kx), noise(5, kx, 2, seed=1), noise(5, ky, 2, seed=2)
    mu, lam = noise(5, kx, seed=3), noise(5, ky, seed=4)
    for batch, alone in (
        (descriptor_energy(fmap, f, g), lambda b: descriptor_energy(fmap[b], f[b], g[b])),
        (commutativity_energy(fmap, mu, lam), lambda b: commutativity_energy(fmap[b], mu[b], lam[b])),
        (orthogonality_energy(fmap), lambda b: orthogonality_energy(fmap[b])),
    ):
        torch.testing.assert_close(batch, torch.stack([alone(b) for b in range(5)]))
    real_x, real_y = torch.tensor([kx, 2, 1, 3, 2]), torch.tensor([ky, 3, 2, 1, 2])  # either side may be the smaller
    mask_x, mask_y = torch.arange(kx) < real_x[:, None], torch.arange(ky) < real_y[:, None]
    padded = fmap * mask_x[:, None] * mask_y[..., None]
    alone = [orthogonality_energy(fmap[b, : real_y[b], : real_x[b]]) for b in range(5)]
    torch.testing.assert_close(orthogonality_energy(padded, mask_x, mask_y), torch.stack(alone))
    one_side = orthogonality_energy(fmap * mask_x[:, None], mask_x)
    torch.testing.assert_close(one_side[1], orthogonality_energy(fmap[1, :, :2]))


def test_an_isometry_has_no_energy(mirror_blob):
    basis = basis_of(mirror_blob.mesh, 20)
    copy = renumbered(mirror_blob, 20)
    fmap = p2p_to_fmap(copy.p2p_yx, basis, copy.basis)
    energies = wave_energies([basis, copy.basis], 10)
    f = basis.coefficients(wave_kernel_signature(basis, energies))
    g = copy.basis.coefficients(wave_kernel_signature(copy.basis, energies))
    assert float(descriptor_energy(fmap, f, g)) < 1e-16
    assert float(commutativity_energy(fmap, basis.evals, copy.basis.evals)) < 1e-16
    assert float(orthogonality_energy(fmap)) < 1e-16
    assert float(descriptor_energy(fmap.flip(0), f, g)) > 1e-3
    assert float(commutativity_energy(fmap.flip(0), basis.evals, copy.basis.evals)) > 1
