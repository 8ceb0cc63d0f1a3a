"""torchqm.fmap.fmap_losses: SURFMNet's values, zero at perfect maps of any shape, padding without effect."""

import pytest
import torch
from references import loss_layers as twin
from references.unchecked import unchecked

from torchqm.fmap.fmap_losses import bijectivity_energy, surfmnet_losses
from torchqm.testing import gradcheck64


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def maps(kx, ky, *batch):
    """Two maps and two ascending spectra."""
    spectra = [noise(*batch, k, seed=s).abs().cumsum(-1) for k, s in ((kx, 2), (ky, 3))]
    return noise(*batch, ky, kx), noise(*batch, kx, ky, seed=1), *spectra


def test_as_the_sums():
    given = maps(5, 5, 3)
    expected = twin.surfmnet(*given, (1.0, 1.0, 1.0))
    got = surfmnet_losses(*given)
    assert got.keys() == expected.keys()
    for name, loss in got.items():
        assert loss.shape == (3,)
        torch.testing.assert_close(loss.mean(), expected[name], rtol=1e-12, atol=0)


@pytest.mark.parametrize(("kx", "ky"), [(4, 4), (6, 4), (4, 6)])
def test_perfect_maps_have_none_of_it(kx, ky):
    fmap = torch.linalg.qr(noise(max(kx, ky), min(kx, ky)))[0]
    fmap = fmap if ky >= kx else fmap.mT
    flat = [torch.ones(k, dtype=torch.float64) for k in (kx, ky)]
    for loss in surfmnet_losses(fmap, fmap.mT, *flat).values():
        assert abs(loss.item()) < 1e-12
    worse = surfmnet_losses(fmap + 0.1 * noise(ky, kx), fmap.mT, *flat)
    assert min(worse["l_bij"], worse["l_orth"]) > 0.1


@pytest.mark.parametrize(("kx", "ky"), [(4, 6), (6, 4)])
def test_rectangular_bijectivity_is_never_negative(kx, ky):
    """Gradient descent from some maps ends at 0, the least value there is."""
    a, b = (0.3 * noise(*size, seed=s).clone() for size, s in (((ky, kx), 0), ((kx, ky), 1)))
    for _ in range(400):
        a.requires_grad_(), b.requires_grad_()
        energy = bijectivity_energy(a, b)
        assert energy.item() > -1e-12
        grads = torch.autograd.grad(energy, (a, b))
        a, b = ((m - 0.05 * g).detach() for m, g in zip((a, b), grads, strict=True))
    assert energy.item() < 1e-6


def test_a_padded_batch_is_its_pairs():
    sizes = [(5, 4), (3, 4), (4, 2), (2, 3)]
    fmap_xy, fmap_yx, evals_x, evals_y = (t.requires_grad_() for t in maps(5, 4, 4))
    mask_x, mask_y = (torch.arange(k) < torch.tensor([s[i] for s in sizes])[:, None] for i, k in ((0, 5), (1, 4)))
    got = surfmnet_losses(fmap_xy, fmap_yx, evals_x, evals_y, mask_x, mask_y)  # padding that is not zero
    for b, (kx, ky) in enumerate(sizes):
        alone = surfmnet_losses(fmap_xy[b, :ky, :kx], fmap_yx[b, :kx, :ky], evals_x[b, :kx], evals_y[b, :ky])
        for name, loss in got.items():
            torch.testing.assert_close(loss[b], alone[name], msg=f"{name} of pair {b}")
    sum(loss.sum() for loss in got.values()).backward()
    assert not fmap_xy.grad[1, :, 3:].any()
    assert not fmap_yx.grad[2, :, 2:].any()


def test_gradients():
    fmap_xy, fmap_yx, evals_x, evals_y = maps(4, 3, 2)
    masks = torch.arange(4) < torch.tensor([[4], [2]]), torch.arange(3) < torch.tensor([[2], [3]])
    for given in ((None, None), masks):
        gradcheck64(
            lambda *t, given=given: tuple(surfmnet_losses(*t, *given).values()), fmap_xy, fmap_yx, evals_x, evals_y
        )


def test_bad_input():
    good = dict(zip(("fmap_xy", "fmap_yx", "evals_x", "evals_y"), maps(3, 2, 2), strict=True))
    for change, message in (
        (
            {"fmap_yx": noise(2, 2, 3)},
            r"fmap_yx: shape \(2, 2, 3\) given, expected \(2, Kx, Ky\) with Kx = 3 as in fmap_xy",
        ),
        ({"evals_y": noise(2, 3)}, r"evals_y: shape \(2, 3\) given, expected \(2, Ky\) with Ky = 2 as in fmap_xy"),
        ({"evals_x": noise(2, 3) * torch.nan}, "evals_x: 6 of 6 entries are NaN"),
        ({"mask_x": torch.zeros(2, 3, dtype=torch.bool)}, r"mask_x: no true element in row\(s\) \[0, 1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            unchecked(surfmnet_losses)(**(good | change))
