"""torchqm.nn.features: features by name are those of the functions, in any batch; the network of points."""

from functools import partial

import pytest
import torch
from references.shapes import basis_of, blob, grid
from references.unchecked import unchecked

from torchqm.data import collate
from torchqm.geometry import vertex_normals
from torchqm.nn import HeatKernelSignature, WaveKernelSignature
from torchqm.nn.features import MLP, InputFeatures

K = 12


def item_of(mesh, scale=1.0):
    basis = basis_of(mesh, K).scaled(scale)
    return {
        "verts": mesh.verts * scale,
        "faces": mesh.faces,
        "mass": basis.mass,
        "evals": basis.evals,
        "evecs": basis.evecs,
    }


@pytest.fixture(scope="module")
def item():
    return item_of(blob(1).mesh)


def test_side_by_side_in_the_order_of_the_names(item):
    features = InputFeatures(("hks", "xyz", "wks", "normals"), n=5, k=K)
    assert features.channels == 16
    basis = item["evals"], item["evecs"], item["mass"]
    found = features(item)
    hks, xyz, wks, normals = found.split([5, 3, 5, 3], -1)
    torch.testing.assert_close(hks, HeatKernelSignature(5, K)(*basis) - 1)
    torch.testing.assert_close(wks, WaveKernelSignature(5, K)(*basis) - 1)
    torch.testing.assert_close(xyz, blob(1).mesh.normalized().verts)
    torch.testing.assert_close(normals, vertex_normals(blob(1).mesh))


@pytest.mark.parametrize("name", ["wks", "hks", "xyz"])
def test_mean_over_a_surface_is_zero(item, name):
    found = InputFeatures(name, n=5, k=K)(item)
    assert float((item["mass"] @ found).abs().max()) < 1e-6 * float(item["mass"].sum())


def test_size_does_not_matter(item):
    features = InputFeatures(("xyz", "normals", "wks", "hks"), n=5, k=K)
    torch.testing.assert_close(features(item_of(blob(1).mesh, 7.0)), features(item))


def test_padding_does_not_matter(item):
    other = item_of(grid(6, 5, 2.0, 1.0))
    other["evals"], other["evecs"] = other["evals"][:9], other["evecs"][:, :9]
    features = InputFeatures(("xyz", "normals", "wks", "hks"), n=5, k=K)
    found = features(collate([other, item]))
    torch.testing.assert_close(found[0, :42], features(other))
    torch.testing.assert_close(found[1], features(item))
    assert not found[0, 42:].any()


def test_full_precision_under_autocast(item):
    features = InputFeatures(("wks",), n=5, k=K)
    single = {name: item[name].float() for name in ("mass", "evals", "evecs")}
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = features(single)
    assert torch.equal(found, WaveKernelSignature(5, K)(single["evals"], single["evecs"], single["mass"]) - 1)


def test_learnable_energies():
    assert not list(InputFeatures(("wks", "hks")).parameters())
    names = [name for name, _ in InputFeatures(("wks", "hks"), learnable=True).named_parameters()]
    assert names == ["wks.log_energies", "wks.log_sigma", "hks.log_times"]


def test_bad_features_are_named(item):
    for names in ((), ("wks", "wks"), ("wks", "shot")):
        with pytest.raises(ValueError, match="each at most once, allowed are xyz, normals, wks, hks"):
            InputFeatures(names)
    features = InputFeatures(("xyz", "wks"), n=5, k=K)
    with pytest.raises(ValueError, match="item: without evals, evecs, which xyz, wks needs; it has verts, "):
        features({name: item[name] for name in ("verts", "faces", "mass")})
    with pytest.raises(ValueError, match=r"verts: 3 of 1926 entries are NaN"):
        features(item | {"verts": item["verts"].clone().index_fill_(0, torch.tensor([3]), torch.nan)})


def test_network_of_points_is_the_formula():
    torch.manual_seed(0)
    net = MLP(4, 3, (6, 5), layer_norm=True)
    x = torch.randn(2, 7, 4)
    h = x
    layers = [layer for layer in net.layers if isinstance(layer, torch.nn.Linear)]
    for layer in layers[:-1]:
        h = h @ layer.weight.T + layer.bias
        h = ((h - h.mean(-1, keepdim=True)) / (h.var(-1, correction=0, keepdim=True) + 1e-5).sqrt()).relu()
    torch.testing.assert_close(net(x), h @ layers[-1].weight.T + layers[-1].bias)
    assert [tuple(layer.weight.shape) for layer in layers] == [(6, 4), (5, 6), (3, 5)]


def test_network_of_points_with_a_mask_and_dropout():
    net = MLP(4, 3, (), dropout=0.3)
    x, mask = torch.randn(2, 7, 4), torch.arange(7).expand(2, 7) < 5
    found = net(x, mask)
    assert not found[:, 5:].any()
    assert torch.equal(found[:, :5], net(x)[:, :5])
    wide = MLP(4, 3, (1000,), dropout=0.3)
    assert not torch.equal(wide(x), wide(x))
    assert torch.equal(wide.eval()(x), wide(x))


def test_bad_input_of_the_network_is_named():
    with pytest.raises(ValueError, match=r"hidden\[0\]: 0 given, expected a whole number from 1 on"):
        MLP(4, 3, (0,))
    net = MLP(4, 3)
    call = partial(unchecked(MLP.forward), net)
    with pytest.raises(ValueError, match=r"feat: shape \(7, 5\) given"):
        call(torch.zeros(7, 5))
    with pytest.raises(ValueError, match="feat: 1 of 28 entries are NaN"):
        call(torch.zeros(7, 4).index_put_((torch.tensor(1), torch.tensor(1)), torch.tensor(torch.nan)))
    with pytest.raises(ValueError, match="verts_mask: no true element"):
        call(torch.zeros(7, 4), torch.zeros(7, dtype=torch.bool))
