"""torchqm.geometry.gradient_features: the sparse product is the dense one; the features do not see the frames."""

import pytest
import torch
from references.shapes import blob, grid, icosphere
from references.unchecked import unchecked

from torchqm.data import collate
from torchqm.geometry import vertex_gradient
from torchqm.geometry.gradient_features import gradient_features, stacked_gradient
from torchqm.testing import gradcheck64


def random(*size, seed=0):
    return torch.randn(*size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def two():
    """Gradients of two shapes of 42 and 24 vertices."""
    return [vertex_gradient(mesh) for mesh in (icosphere(1), grid(5, 3))]


@pytest.mark.parametrize("form", ["stacked", "block", "list"])
def test_dense_twin_in_every_form_of_a_batch(two, form):
    batch = collate([{"gradX": g.grad_x, "gradY": g.grad_y} for g in two], form)
    found_x, found_y = stacked_gradient(batch["gradX"], batch["gradY"], (2,), 42)(random(2, 42, 3))
    for i, (g, n) in enumerate(zip(two, (42, 24), strict=True)):
        own = random(2, 42, 3)[i, :n]
        torch.testing.assert_close(found_x[i, :n], g.grad_x.to_dense() @ own)
        torch.testing.assert_close(found_y[i, :n], g.grad_y.to_dense() @ own)
        assert not found_x[i, n:].any()
        assert not found_y[i, n:].any()


def test_one_shape_and_any_number_of_batch_dimensions(two):
    g = two[0]
    values = random(2, 2, 42, 3)
    x, y = stacked_gradient([g.grad_x] * 4, [g.grad_y] * 4, (2, 2), 42)(values)
    one_x, one_y = stacked_gradient(g.grad_x, g.grad_y.to_sparse_csr(), (), 42)(values[1, 0])
    torch.testing.assert_close(x[1, 0], one_x)
    torch.testing.assert_close(y[1, 0], one_y)
    torch.testing.assert_close(one_x, g.grad_x.to_dense() @ values[1, 0])


def test_entries_in_no_order_and_given_twice(two):
    g = two[0]
    indices, entries = g.grad_x.indices(), g.grad_x.values() / 2
    order = torch.randperm(len(entries), generator=torch.Generator().manual_seed(0))
    loose = torch.sparse_coo_tensor(
        torch.cat([indices[:, order], indices], 1),
        torch.cat([entries[order], entries]),
        (42, 42),
        check_invariants=False,
    )
    x, _ = stacked_gradient(loose, g.grad_y, (), 42)(random(42, 3))
    torch.testing.assert_close(x, g.grad_x.to_dense() @ random(42, 3))


def test_gradients_of_the_sparse_product_of_first_and_second_order():
    g = vertex_gradient(icosphere(0))
    operator = stacked_gradient([g.grad_x] * 2, [g.grad_y] * 2, (2,), 12)
    gradcheck64(operator, random(2, 12, 2))
    values = random(2, 12, 2).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda f: sum(part.pow(3).sum() for part in operator(f)), values)


def test_bad_matrices_are_named(two):
    g = two[0]
    make = unchecked(stacked_gradient)
    with pytest.raises(ValueError, match=r"grad_x: shape \(42, 42\) given, expected \(2, 42, 42\) or \(84, 84\)"):
        make(g.grad_x, g.grad_y, (2,), 42)
    with pytest.raises(ValueError, match=r"grad_y: a dense tensor of shape \(42, 42\) given, expected a sparse one"):
        make(g.grad_x, g.grad_y.to_dense(), (), 42)
    with pytest.raises(ValueError, match=r"grad_x: shapes \[\(42, 42\)\] given, expected 2 matrices of at most 42"):
        make([g.grad_x], [g.grad_y], (2,), 42)
    with pytest.raises(ValueError, match=r"grad_x: needs a gradient, .* give grad_x.detach\(\)"):
        make(g.grad_x.clone().requires_grad_(), g.grad_y, (), 42)


def test_features_are_those_of_complex_numbers():
    x, y, real, imaginary = random(4, 5, 5).unbind()
    w, a = torch.complex(x, y), torch.complex(real, imaginary)
    expected = torch.stack([torch.tanh((v.conj() * (a @ v)).real) for v in w])
    torch.testing.assert_close(gradient_features(x, y, real, imaginary), expected)
    expected = torch.stack([torch.tanh((v.conj() * (real.to(a.dtype) @ v)).real) for v in w])
    torch.testing.assert_close(gradient_features(x, y, real), expected)


def test_features_do_not_change_with_the_frames():
    mesh = blob(1).mesh
    usual = vertex_gradient(mesh)
    angle = random(mesh.n_verts)
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    x, y, normal = usual.frames.unbind(1)
    turned = vertex_gradient(mesh, torch.stack([cos * x + sin * y, cos * y - sin * x, normal], 1))
    mirrored = vertex_gradient(mesh, torch.stack([x, -y, -normal], 1))
    real, imaginary = random(2, 4, 4, seed=1)

    def features(gradient, imaginary):
        pair = stacked_gradient(gradient.grad_x, gradient.grad_y, (), mesh.n_verts)(mesh.verts @ random(3, 4) / 3)
        return gradient_features(*pair, real, imaginary)

    torch.testing.assert_close(features(turned, imaginary), features(usual, imaginary))
    # Left-handed frames are those of the mirror image: only the imaginary part sees them.
    torch.testing.assert_close(features(mirrored, -imaginary), features(usual, imaginary))
    torch.testing.assert_close(features(mirrored, None), features(usual, None))
    assert float((features(mirrored, imaginary) - features(usual, imaginary)).abs().max()) > 0.1


def test_gradients_of_the_features():
    x, y = random(2, 2, 3, 3).unbind()
    real, imaginary = random(2, 3, 3, seed=1)
    gradcheck64(gradient_features, x, y, real, imaginary)
    gradcheck64(gradient_features, x, y, real)
