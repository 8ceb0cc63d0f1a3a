"""torchqm.nn.loss: the layers are the functions, with ULRSSM's call; compiled, exported and under vmap."""

from pathlib import Path

import pytest
import torch
from references import loss_layers as twin

from torchqm.fmap import orbit_loss
from torchqm.fmap.orbit_consistency import orbit_consistency_fmap, orbit_consistency_points
from torchqm.nn.loss import FunctionalMapLoss, OrbitConsistencyLoss, PointToOrbitLoss

ROOT = Path(__file__).resolve().parent.parent.parent


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
@pytest.mark.parametrize("weights", [(1.0, 1.0, 1e-3), (2.0, 0.5, 1.0)])
def test_ulrssm_values(dtype, rtol, weights):
    c12, c21 = noise(3, 20, 20, dtype=dtype), noise(3, 20, 20, seed=1, dtype=dtype)
    evals = [noise(3, 20, seed=s).abs().mul(20).cumsum(-1).to(dtype) for s in (2, 3)]
    expected = twin.surfmnet(c12.double(), c21.double(), *(e.double() for e in evals), weights)
    got = FunctionalMapLoss(*weights)(c12, c21, *evals)
    assert list(got) == ["l_bij", "l_orth", "l_lap"]
    for name, loss in got.items():
        assert loss.dtype == dtype
        torch.testing.assert_close(loss.double(), expected[name], rtol=rtol, atol=0)


def test_a_weight_of_zero_leaves_its_loss_out():
    eye, evals = torch.eye(3)[None], torch.ones(1, 3)
    for off in ("w_bij", "w_orth", "w_lap"):
        found = FunctionalMapLoss(**{off: 0.0})(eye, eye, evals, evals)
        assert set(found) == {"l_bij", "l_orth", "l_lap"} - {off.replace("w_", "l_")}
    with pytest.raises(ValueError, match="w_orth: -1 given, expected a number from 0 on"):
        FunctionalMapLoss(w_orth=-1)


def batch():
    table = torch.stack([twin.dihedral(3, seed) for seed in (0, 1)])
    v = table.shape[-1]
    soft = torch.softmax(noise(2, 7, v), -1)
    even_y = torch.stack([noise(v, 4, seed=s)[t].mean(0) for s, t in enumerate(table)])
    dist = noise(2, v, v).abs()
    points = {"p2p_xy": torch.tensor([[0, 1, 2], [3, -1, 5]]), "samples": torch.tensor([[6, 0, 2], [1, 2, 3]])}
    points |= {"mass_x": noise(2, 7).abs(), "truth_mask": torch.tensor([[True, True, False], [True] * 3])}
    group = {"soft_xy": soft, "group_y": table, "group_mask": torch.arange(6) < torch.tensor([[6], [6]])}
    spectral = {"fmap_even": noise(2, 4, 3), "evecs_even_x": noise(2, 7, 3), "evecs_even_y": even_y}
    return points, {
        "spectral": (spectral, {}),
        "assignment": (group, {"eps": 1e-6}),
        "distance": ({**group, "dist_y": dist}, {}),
        "map": ({**group, "dist_y": dist}, {"temperature": 0.2}),
    }


@pytest.mark.parametrize("form", ["spectral", "assignment", "distance", "map"])
def test_orbit_layer_is_the_function(form):
    points, forms = batch()
    given, options = forms[form]
    expected = getattr(orbit_loss, f"{form}_orbit_loss")(**points, **given, **options)
    assert expected.shape == (2,)
    assert torch.equal(PointToOrbitLoss(form, "none", **options)(**points, **given), expected)
    assert torch.equal(PointToOrbitLoss(form, **options)(**points, **given), expected.mean())


def test_consistency_layer_is_the_function():
    table = torch.stack([twin.dihedral(3, seed) for seed in (0, 1)])
    soft, values, mass = torch.softmax(noise(2, 10, 10), -1), noise(2, 10, 2), noise(2, 10).abs()
    pairings = torch.tensor([[0, 1, 2, 3, 4, 5], [0, 1, 4, 5, 2, 3]])
    given = {"values_y": values, "mass_x": mass, "pairings": pairings}
    expected = orbit_consistency_points(soft, table, table.flip(0), **given, temperature=0.3)
    assert torch.equal(OrbitConsistencyLoss("points", "none", 0.3)(soft, table, table.flip(0), **given), expected)
    s = noise(2, 6, 3, 3)
    expected = orbit_consistency_fmap(noise(2, 3, 3), s, s.flip(0), pairings=pairings)
    assert torch.equal(OrbitConsistencyLoss()(noise(2, 3, 3), s, s.flip(0), pairings=pairings), expected.mean())


def test_bad_options_and_arguments():
    for make, message in (
        (lambda: PointToOrbitLoss("nearest"), "form: 'nearest' given, allowed are spectral, assignment, distance, map"),
        (lambda: PointToOrbitLoss(reduction="sum"), "reduction: 'sum' given, allowed are mean, none"),
        (lambda: PointToOrbitLoss("distance", eps=0.1), "eps: the form 'distance' has no such option; it has none"),
        (lambda: OrbitConsistencyLoss("dense"), "form: 'dense' given, allowed are fmap, points"),
        (lambda: OrbitConsistencyLoss(reduction="sum"), "reduction: 'sum' given"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    points, forms = batch()
    given = dict(forms["assignment"][0])
    with pytest.raises(ValueError, match="dist_y: given, but the form 'assignment' takes soft_xy, group_y, group_mask"):
        PointToOrbitLoss()(**points, **given, dist_y=noise(2, 10, 10))
    del given["group_y"]
    with pytest.raises(ValueError, match="group_y: not given, but the form 'assignment' needs it"):
        PointToOrbitLoss()(**points, **given)
