"""torchqm.symmetry.soft: one projection from vertex maps, functional matrices or soft maps, batched, with gradients."""

import pytest
import torch
from references import split_layers as twin
from references.shapes import basis_of, blob, box
from references.unchecked import unchecked

from torchqm import checks
from torchqm.data.collate import collate
from torchqm.spectral import SoftMap
from torchqm.symmetry import projection_matrix
from torchqm.symmetry.soft import projection_matrices
from torchqm.testing import gradcheck64

project = unchecked(projection_matrices)


def item(shape, k):
    basis = basis_of(shape.mesh, k)
    return {
        "verts": shape.mesh.verts,
        "evals": basis.evals,
        "evecs": basis.evecs,
        "mass": basis.mass,
        "group": shape.group.maps,
    }


@pytest.fixture(scope="module")
def batch():
    """Unequal V, K and order."""
    return collate([item(blob(4), 12), item(box(), 9), item(blob(1), 7)])


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def small(seed=0, n=6, k=4):
    """Two small bases (not orthonormal: the formula does not ask) and a table of three maps, not all permutations."""
    maps = torch.stack([torch.arange(n), torch.arange(n).flip(0), torch.tensor([1, 1, 0, 3, 5, 5])])
    evecs, mass = noise(2, n, k, seed=seed), noise(2, n, seed=seed + 1).abs()
    return evecs, mass, torch.stack([maps, maps[[0, 2, 1]]])


def test_one_shape(blob):
    basis = basis_of(blob.mesh, 15)
    found = projection_matrices(basis.evecs, basis.mass, group=blob.group.maps)
    torch.testing.assert_close(found, projection_matrix(basis, blob.group), atol=1e-12, rtol=0)
    torch.testing.assert_close(found, twin.projection(basis.evecs, basis.mass, blob.group.maps), atol=1e-12, rtol=0)


def test_a_batch_of_unequal_shapes(batch):
    """Each as alone, zeros beside it, and what stands in the padding does not matter."""
    masks = {name: batch[name] for name in ("group_mask", "verts_mask", "evals_mask")}
    evecs, mass = batch["evecs"].clone(), batch["mass"].clone()
    evecs[~masks["verts_mask"]] = 7.0
    evecs.mT[~masks["evals_mask"]] = 7.0
    mass[~masks["verts_mask"]] = 7.0
    for given in ((batch["evecs"], batch["mass"]), (evecs, mass)):
        found = projection_matrices(*given, group=batch["group"], **masks)
        for row, (shape, k) in zip(found, ((blob(4), 12), (box(), 9), (blob(1), 7)), strict=True):
            alone = projection_matrix(basis_of(shape.mesh, k), shape.group)
            torch.testing.assert_close(row[:k, :k], alone, atol=1e-12, rtol=0)
            assert row[k:].abs().sum() + row[:, k:].abs().sum() == 0


def test_any_kind_of_symmetry_gives_one_projection():
    shape = blob(2)
    basis = basis_of(shape.mesh, 10)
    maps = shape.group.maps
    expected = projection_matrices(basis.evecs, basis.mass, group=maps)
    fmaps = torch.stack([basis.coefficients(basis.evecs[g]) for g in maps])
    sparse = SoftMap.from_p2p(maps[1], 642)
    kinds = [{"fmaps": fmaps}, {"fmaps": fmaps[1]}, {"soft_map": sparse}, {"soft_map": sparse.to_dense()}]
    for kind in kinds:
        found = projection_matrices(basis.evecs, basis.mass, **kind)
        torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)


def test_masked_functional_matrices():
    evecs, mass, _ = small()
    fmaps, mask = noise(2, 3, 4, 4), torch.tensor([[True, True, True], [True, False, False]])
    real = torch.tensor([[True] * 4, [True, True, False, False]])
    found = projection_matrices(evecs, mass, fmaps=fmaps, group_mask=mask, evals_mask=real)
    torch.testing.assert_close(found[0], fmaps[0].mean(0))
    torch.testing.assert_close(found[1, :2, :2], fmaps[1, 0, :2, :2])
    assert found[1, 2:].abs().sum() == 0


@pytest.mark.parametrize("masked", [False, True])
def test_gradients(masked):
    evecs, mass, group = small()
    masks, element = {}, {}
    if masked:
        masks = {
            "verts_mask": torch.tensor([[True] * 6, [True] * 5 + [False]]),
            "evals_mask": torch.tensor([[True] * 3 + [False], [True] * 4]),
        }
        group[1] = torch.arange(6)
        element = {"group_mask": torch.tensor([[True, True, True], [True, False, True]])}
    fmaps, weights, ids = noise(2, 3, 4, 4), noise(2, 6, 2).abs(), torch.arange(24).reshape(2, 6, 2) * 5 % 6

    def by_group(e, m):
        return projection_matrices(e, m, group=group, **masks, **element)

    def by_fmaps(f, reflection):
        many = projection_matrices(evecs, mass, fmaps=f, **masks, **element)
        return many, projection_matrices(evecs, mass, fmaps=reflection, **masks)

    def by_soft(e, m, w, dense):
        sparse = projection_matrices(e, m, soft_map=SoftMap(ids, w, 6), **masks)
        return sparse, projection_matrices(e, m, soft_map=dense, **masks)

    assert gradcheck64(by_group, evecs, mass)
    assert gradcheck64(by_fmaps, fmaps, fmaps[:, 0])
    assert gradcheck64(by_soft, evecs, mass, weights, noise(2, 6, 6, seed=5))


def test_second_derivatives():
    """Nothing here is singular, so the inner products' own backward pass can be differentiated again."""
    evecs, mass, group = small(k=2)
    inputs = (evecs.requires_grad_(), mass.requires_grad_())
    assert torch.autograd.gradgradcheck(lambda e, m: projection_matrices(e, m, group=group), inputs)


def test_only_what_is_needed_is_differentiated():
    evecs, mass, group = small()
    total = projection_matrices(evecs, mass.requires_grad_(), group=group).square().sum()
    (grad,) = torch.autograd.grad(total, mass)
    assert grad.shape == mass.shape
    assert evecs.grad is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"group": None}, "given by nothing: exactly one of group, fmaps, soft_map"),
        ({"fmaps": noise(2, 4, 4)}, r"given by \['group', 'fmaps'\]: exactly one"),
        ({"mass": -torch.ones(2, 6).double()}, r"mass: 12 of 12 entries are negative"),
        ({"mass": torch.ones(2, 5).double()}, r"mass: shape \(2, 5\) given, expected \(2, V\) with V = 6 as in evecs"),
        ({"evecs": noise(2, 6, 4) / 0}, "evecs: 48 of 48 entries are NaN or infinite"),
        ({"group": torch.zeros(2, 2, 6).long()}, "row 0 must be the identity"),
        ({"group": torch.arange(6).repeat(2, 2, 1) - 1}, r"group: ids from -1 to 4 given, allowed are 0\.\.5"),
        ({"group": torch.arange(6.0).repeat(2, 2, 1)}, "group: dtype torch.float32 given, expected vertex ids"),
        ({"group": torch.arange(5).repeat(2, 2, 1)}, r"group: shape \(2, 2, 5\) given"),
        ({"verts_mask": torch.ones(2, 6)}, "verts_mask: dtype torch.float32 given, expected torch.bool"),
        ({"verts_mask": torch.zeros(2, 6).bool()}, r"verts_mask: no true element in row\(s\) \[0, 1\]"),
        (
            {"verts_mask": (torch.arange(6) < 4).repeat(2, 1)},
            r"real vertex goes to a padded one, the first at \(0, 1, 0",
        ),
        ({"evals_mask": torch.ones(2, 3).bool()}, r"evals_mask: shape \(2, 3\) given, expected \(2, K\) with K = 4"),
        ({"group_mask": torch.tensor([[False, True, True]] * 2)}, "element 0, the identity, must be real"),
        ({"group": None, "fmaps": noise(2, 3, 3)}, r"fmaps: shape \(2, 3, 3\) given"),
        ({"group": None, "fmaps": noise(2, 4, 4), "group_mask": torch.ones(2, 3).bool()}, "no table of maps or matr"),
        ({"group": None, "soft_map": noise(2, 6, 5)}, r"soft_map: shape \(2, 6, 5\) given, expected \(2, V, V\)"),
        ({"group": None, "soft_map": noise(2, 6, 6) / 0}, "soft_map: 72 of 72 entries are NaN or infinite"),
        ({"group": None, "soft_map": SoftMap(torch.ones(2, 6, 1).long(), noise(2, 6, 1), 7)}, "a self-map is needed"),
        (
            {"group": None, "soft_map": SoftMap(torch.full((2, 6, 1), 6), noise(2, 6, 1), 6)},
            r"soft_map.indices: ids from 6 to 6 given",
        ),
    ],
)
def test_what_is_wrong_is_named(change, message):
    evecs, mass, group = small()
    arguments = {"evecs": evecs, "mass": mass, "group": group} | change
    with pytest.raises(ValueError, match=message):
        project(**arguments)


def test_checks_of_values_can_be_switched_off():
    evecs, mass, group = small()
    with checks.disabled():
        assert bool(torch.isnan(projection_matrices(evecs * torch.nan, mass, group=group)).all())
