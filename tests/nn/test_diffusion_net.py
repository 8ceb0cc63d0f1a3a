"""torchqm.nn.diffusion_net: a shape has its features, whatever its numbering, place, size and batch."""

import io
import subprocess
import sys
from functools import partial

import pytest
import torch
from references.diffusion_net import dense_net
from references.shapes import basis_of, blob, grid
from references.unchecked import unchecked

from torchqm.data import collate
from torchqm.geometry import Mesh, vertex_gradient
from torchqm.nn.diffusion_net import DiffusionNet
from torchqm.nn.features import InputFeatures
from torchqm.spectral import mesh_basis

K = 12
CLOSE = {"rtol": 1e-6, "atol": 1e-7}  # of eigenfunctions found twice


def item_of(mesh, basis=None):
    basis = basis or mesh_basis(mesh, K)
    gradient = vertex_gradient(mesh)
    item = {"verts": mesh.verts, "faces": mesh.faces, "mass": basis.mass, "evals": basis.evals, "evecs": basis.evecs}
    item |= {"gradX": gradient.grad_x, "gradY": gradient.grad_y}
    return with_features(item)


def with_features(item):
    return item | {"feat": FEATURES(item)}


FEATURES = InputFeatures(("wks", "hks"), n=3, k=K)


@pytest.fixture(scope="module")
def item():
    return item_of(blob(1).mesh, basis_of(blob(1).mesh, K))


def small(**options):
    torch.manual_seed(0)
    made = {"C_in": 6, "C_out": 3, "C_width": 8, "N_block": 2} | options
    return DiffusionNet(**made).double().eval()


def run(net, item, **others):
    names = ("mass", "evals", "evecs", "gradX", "gradY")
    return net(item["feat"], **{name: item[name] for name in names}, **others)


def cast(item, dtype):
    return {name: value.to(dtype) if value.is_floating_point() else value for name, value in item.items()}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"with_gradient_rotations": False},
        {"with_gradient_features": False},
        {"mlp_hidden_dims": (5,), "N_block": 1},
    ],
)
def test_dense_twin(options):
    mesh = grid(6, 5, 2.0, 1.5)
    one = item_of(mesh, basis_of(mesh, K))
    net = small(**options)
    # At area one the derivatives are those of the larger shape times the root of its area.
    gradients = [one[name] * mesh.area**0.5 for name in ("gradX", "gradY")]
    torch.testing.assert_close(run(net, one), dense_net(net, one["feat"], basis_of(mesh, K), *gradients))


def test_numbering_does_not_matter(item):
    mesh = blob(1).mesh
    order = torch.randperm(mesh.n_verts, generator=torch.Generator().manual_seed(1))
    faces = torch.argsort(order)[mesh.faces].flip(0).roll(1, 1)
    renumbered = item_of(Mesh(mesh.verts[order], faces))
    net = small()
    torch.testing.assert_close(run(net, renumbered), run(net, item)[order], **CLOSE)


def test_place_and_size_do_not_matter(item):
    mesh = blob(1).mesh
    generator = torch.Generator().manual_seed(2)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator)).Q
    turn = turn * torch.linalg.det(turn)
    moved = item_of(mesh.moved(7 * mesh.verts @ turn.T + 3))
    assert float((moved["gradX"].to_dense() * 7 - item["gradX"].to_dense()).abs().max()) > 1  # in other frames
    net = small()
    torch.testing.assert_close(run(net, moved), run(net, item), **CLOSE)


def test_signs_of_eigenfunctions_do_not_matter(item):
    signs = torch.tensor([1.0, -1.0] * (K // 2), dtype=torch.float64)
    torch.testing.assert_close(run(small(), item | {"evecs": item["evecs"] * signs}), run(small(), item))


def test_only_rotations_tell_left_from_right():
    shape = blob(2)
    one = item_of(shape.mesh, basis_of(shape.mesh, K))
    one["feat"] = 10 * one["feat"]  # products of gradients far from zero
    mirror = shape.group.maps[1]
    blind, seeing = run(small(with_gradient_rotations=False), one), run(small(), one)
    torch.testing.assert_close(blind[mirror], blind, **CLOSE)
    assert float((seeing[mirror] - seeing).detach().abs().max()) > 1e-3


def test_padding_does_not_matter(item):
    other = item_of(grid(6, 5, 2.0, 1.0))
    pair = [{name: one[name] for name in one if name != "feat"} for one in (other, item)]
    batch = with_features(collate(pair))
    net = small()
    found = run(net, batch, verts_mask=batch["verts_mask"])
    torch.testing.assert_close(found[0, :42], run(net, other))
    torch.testing.assert_close(found[1], run(net, item))
    assert not found[0, 42:].any()
    means = run(small(outputs_at="global_mean"), batch)
    expected = [(one["mass"][:, None] * run(net, one)).sum(0) / one["mass"].sum() for one in (other, item)]
    torch.testing.assert_close(means, torch.stack(expected))


def test_last_activation():
    mesh = grid(6, 5)
    one = item_of(mesh, basis_of(mesh, K))
    net = small(last_activation=partial(torch.softmax, dim=-1), outputs_at="global_mean")
    torch.testing.assert_close(run(net, one), run(small(outputs_at="global_mean"), one).softmax(-1))


def test_single_precision_and_autocast(item):
    net, single = small(), small().float()
    low = cast(item, torch.float32)
    found = run(single, low)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), run(net, item), rtol=1e-3, atol=1e-4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = run(single, low | {"feat": low["feat"].bfloat16()})
    assert float((mixed - found).detach().norm() / found.detach().norm()) < 0.02


def test_learns_left_and_right_from_signatures_with_rotations_only():
    mesh = blob(2).mesh
    one = item_of(mesh, basis_of(mesh, 60))
    one["feat"] = InputFeatures(("wks",), n=32, k=60)(one)
    target = (5 * mesh.verts[:, :1]).tanh()  # odd
    losses = {}
    for rotations in (True, False):
        net = small(C_in=32, C_out=1, C_width=16, dropout=False, with_gradient_rotations=rotations)
        optimizer = torch.optim.Adam(net.parameters(), 1e-2)
        for _ in range(40):
            optimizer.zero_grad()
            loss = (run(net, one) - target).square().mean()
            loss.backward()
            assert all(bool(p.grad.any()) for p in net.parameters())
            optimizer.step()
        losses[rotations] = float(loss.detach())
    nothing = float(target.square().mean())
    assert losses[True] < 0.5 * nothing
    assert losses[False] >= nothing - 1e-9  # the best even function is zero


@pytest.mark.parametrize("size", [1e3, -1e3])
def test_extreme_times_are_positive_and_finite(item, size):
    net = small(dropout=False)
    with torch.no_grad():
        for block in net.blocks:
            block.log_times.fill_(size)
    feat = item["feat"].clone().requires_grad_()
    evals = torch.cat([item["evals"].new_zeros(1), item["evals"][1:]])  # 0 exactly, as not every solver finds it
    out = run(net, item | {"feat": feat, "evals": evals})
    out.sum().backward()
    assert torch.isfinite(out).all()
    assert torch.isfinite(feat.grad).all()


def test_state_is_saved_and_loaded_without_pickle(item):
    net, other = small(), small()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1)
    file = io.BytesIO()
    torch.save(net.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(run(other, item), run(net, item))


def test_dropout_is_in_the_mlp_of_each_block():
    def probabilities(**options):
        return [part.p for part in small(**options).modules() if isinstance(part, torch.nn.Dropout)]

    assert probabilities() == [0.5] * 4
    assert probabilities(dropout=0.1, N_block=1) == [0.1] * 2
    assert probabilities(dropout=False) == []


def test_bad_input_is_named(item):
    net = small()
    call = partial(unchecked(DiffusionNet.forward), net)
    feat, mass, basis = item["feat"], item["mass"], {"evals": item["evals"], "evecs": item["evecs"]}
    both = {"gradX": item["gradX"], "gradY": item["gradY"]}
    with pytest.raises(ValueError, match="evals, evecs: not given; spectral diffusion needs both"):
        call(feat, mass, **both)
    with pytest.raises(ValueError, match="gradX, gradY: not given; needed unless with_gradient_features=False"):
        call(feat, mass, **basis)
    with pytest.raises(ValueError, match=r"x_in: shape \(642, 5\) given, expected \(V, 6\)|\(\.\.\., V, 6\)"):
        call(feat[:, 1:], mass, **basis, **both)
    with pytest.raises(ValueError, match=r"mass: shape \(641,\) given, expected \(V,\) with V = 642 as in x_in"):
        call(feat, mass[1:], **basis, **both)
    with pytest.raises(ValueError, match="x_in: 6 of 3852 entries are NaN"):
        call(feat.clone().index_fill_(0, torch.tensor([4]), torch.nan), mass, **basis, **both)
    with pytest.raises(ValueError, match="mass: 1 of 642 entries are negative"):
        call(feat, mass.clone().index_fill_(0, torch.tensor([4]), -1.0), **basis, **both)
    with pytest.raises(ValueError, match=r"evecs: dtype torch.float32 given, but the weights are torch.float64"):
        call(feat, mass, evals=item["evals"], evecs=item["evecs"].float(), **both)
    with pytest.raises(ValueError, match=r"gradX, gradY: dtype torch.float32 given"):
        call(feat, mass, **basis, gradX=item["gradX"].float(), gradY=item["gradY"].float())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"outputs_at": "faces"}, "outputs_at: 'faces' given, allowed are vertices, global_mean"),
        ({"diffusion_method": "implicit_dense"}, "diffusion_method: 'implicit_dense' given, allowed are spectral"),
        ({"dropout": 1.0}, "dropout: 1.0 given, expected a number from 0 below 1"),
        ({"N_block": 0}, "N_block: 0 given, expected a whole number from 1 on"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        small(**options)


def test_compiles_in_one_graph_without_gradient_features():
    code = """
import torch
from torchqm.nn.diffusion_net import DiffusionNet
net = DiffusionNet(4, 3, 8, 2, with_gradient_features=False).eval()
evals, evecs = torch.arange(5.0).expand(2, 5), torch.randn(2, 20, 5)
given = {"mass": torch.rand(2, 20), "evals": evals, "evecs": evecs, "verts_mask": torch.arange(20).expand(2, 20) < 18}
x = torch.randn(2, 20, 4)
compiled = torch.compile(net, fullgraph=True, backend="eager")
torch.testing.assert_close(compiled(x, **given), net(x, **given))
torch.testing.assert_close(torch.export.export(net, (x,), given).module()(x, **given), net(x, **given))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
