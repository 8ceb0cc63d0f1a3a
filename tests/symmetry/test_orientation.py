"""torchqm.symmetry.orientation: exact integrals, signs under reflections and flipped faces."""

from dataclasses import replace
from math import pi

import pytest
import torch
from references.dense import orientation_coefficients as slow_coefficients
from references.shapes import basis_of, icosphere, rotation

from torchqm.geometry import Mesh
from torchqm.symmetry import (
    function_pairs,
    orientation_coefficients,
    orientation_cosine,
    orientation_form,
    orientation_tensor,
    symmetrized_basis,
)

PAIR = torch.tensor([[0], [1]])


def test_function_pairs():
    assert function_pairs(5).shape == (2, 6)
    assert function_pairs(2).shape == (2, 0)
    assert function_pairs(1).shape == (2, 0)
    a, b = function_pairs(6)
    assert bool((a < b).all())
    assert int(a.min()) == 1
    assert len(set(zip(a.tolist(), b.tolist(), strict=True))) == 10


def test_integral_on_the_sphere():
    """On the unit sphere n . (grad x cross grad y) = z, and the integral of z^2 is 4 pi / 3."""
    errors = []
    for level in (2, 3, 4):
        mesh = icosphere(level)
        found = orientation_coefficients(mesh, mesh.verts[:, :2], PAIR, mesh.verts[:, 2:])
        errors.append(abs(float(found) - 4 * pi / 3))
    assert errors[2] < 0.01
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)


def test_is_the_formula_in_space(mirror_blob):
    mesh, basis = mirror_blob.mesh, basis_of(mirror_blob.mesh, 8)
    pairs = torch.tensor([[1, 4], [2, 3]])
    fast = orientation_coefficients(mesh, basis.evecs, pairs, basis.evecs)
    for p, (a, b) in enumerate(pairs.T.tolist()):
        for k in (5,):
            slow = slow_coefficients(mesh.verts, mesh.faces, *(basis.evecs[:, i] for i in (a, b, k)))
            assert float(fast[k, p]) == pytest.approx(slow, abs=1e-12)


def test_is_antisymmetric_and_blind_to_constants(mirror_blob):
    mesh, basis = mirror_blob.mesh, basis_of(mirror_blob.mesh, 8)
    pairs = function_pairs(8)
    form = orientation_form(mesh, basis.evecs, pairs)
    assert torch.equal(orientation_form(mesh, basis.evecs, pairs.flip(0)), -form)
    torch.testing.assert_close(orientation_form(mesh, basis.evecs + 7, pairs), form, atol=1e-13, rtol=0)
    same = pairs[:1].expand(2, -1).contiguous()
    assert orientation_form(mesh, basis.evecs, same).abs().max() == 0
    # a total derivative: on a closed surface it integrates to zero
    assert orientation_coefficients(mesh, basis.evecs, pairs, torch.ones(642, 1).double()).abs().max() < 1e-12


def test_flipped_faces_change_the_sign_and_motion_nothing(mirror_blob):
    mesh, basis = mirror_blob.mesh, basis_of(mirror_blob.mesh, 8)
    pairs = function_pairs(8)
    coefficients = orientation_coefficients(mesh, basis.evecs, pairs, basis.evecs)
    inside_out = Mesh(mesh.verts, mesh.faces.flip(1))
    torch.testing.assert_close(
        orientation_coefficients(inside_out, basis.evecs, pairs, basis.evecs), -coefficients, atol=1e-15, rtol=0
    )
    moved = mesh.moved(3 * mesh.verts @ rotation(0).T + 1)
    assert torch.equal(orientation_coefficients(moved, basis.evecs, pairs, basis.evecs), coefficients)


def test_symmetric_functions_give_odd_ones(mirror_blob):
    mesh, group = mirror_blob
    split = symmetrized_basis(basis_of(mesh, 30), group)
    pairs = function_pairs(6)
    on_even = orientation_coefficients(mesh, split.even.evecs, pairs, split.even.evecs)
    on_odd = orientation_coefficients(mesh, split.even.evecs, pairs, split.odd.evecs)
    assert on_even.abs().max() < 1e-8
    assert on_odd.abs().max() > 0.1
    mirrored = orientation_coefficients(mesh, split.even.evecs, pairs, split.odd.evecs[group.maps[1]])
    torch.testing.assert_close(mirrored, -on_odd, atol=1e-8, rtol=0)


def test_the_tensor_is_the_form_of_all_pairs(blob):
    basis = basis_of(blob.mesh, 12)
    omega = orientation_tensor(blob.mesh, basis, n=6, k=9)
    assert omega.shape == (9, 6, 6)
    pairs = function_pairs(6)
    wanted = orientation_coefficients(blob.mesh, basis.evecs[:, :6], pairs, basis.evecs[:, :9])
    assert torch.allclose(omega[:, pairs[0], pairs[1]], wanted, atol=1e-12)
    assert torch.equal(omega, -omega.transpose(1, 2))


def test_cosines_of_exact_symmetries(prism):
    """Also on every fourth triangle only, and between a shape and its mirror image."""
    basis = basis_of(prism.mesh, 40)
    whole = orientation_tensor(prism.mesh, basis)
    few = orientation_tensor(prism.mesh, basis, n_faces=prism.mesh.n_faces // 4)
    verts = prism.mesh.verts - prism.mesh.verts.mean(0)
    for element in prism.group.maps:
        turn = torch.linalg.lstsq(verts, verts[element]).solution
        sign = round(float(torch.linalg.det(turn)))
        fmap = basis.coefficients(basis.evecs[element]).T  # push-forward: the transpose of the pull-back
        assert orientation_cosine(fmap, whole, whole) == pytest.approx(sign, abs=1e-6)
        assert orientation_cosine(fmap, few, few) * sign > 0.5
    inside_out = replace(prism.mesh, faces=prism.mesh.faces.flip(1))
    other = orientation_tensor(inside_out, basis)
    identity = torch.eye(40, dtype=torch.float64)
    assert orientation_cosine(identity, whole, other) == pytest.approx(-1)


def test_blocks_of_triangles_give_what_the_forms_give(mirror_blob):
    """Against the form of every triangle, spread to its corners; some blocks of triangles, pairs in any order."""
    mesh, basis = mirror_blob.mesh, basis_of(mirror_blob.mesh, 8)
    assert mesh.n_faces > 1024
    pairs = torch.tensor([[7, 1, 3, 3], [2, 5, 3, 1]])
    form = orientation_form(mesh, basis.evecs, pairs)
    spread = torch.zeros(mesh.n_verts, 4, dtype=form.dtype)
    for corner in range(3):
        spread.index_add_(0, mesh.faces[:, corner], form / 3)
    found = orientation_coefficients(mesh, basis.evecs, pairs, basis.evecs)
    torch.testing.assert_close(found, basis.evecs.T @ spread, atol=1e-12, rtol=1e-12)
