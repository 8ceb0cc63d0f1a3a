from dataclasses import replace

import pytest
import torch
from references.sets import Blobs
from references.shapes import grid

from torchqm.data.base import Truth, TruthError
from torchqm.data.items import ITEM_KEYS, ItemOptions, make_item, template_corr
from torchqm.geometry import Mesh, MeshError, distances, lumped_mass
from torchqm.geometry.gradient import vertex_gradient
from torchqm.spectral import mesh_basis
from torchqm.spectral.cache import cached_basis

DESIGN = (
    "name, verts, faces, mass, L, evals, evecs, evecs_trans, gradX, gradY, dist, corr, group, evals_even, evecs_even, "
    "evals_odd, evecs_odd"
)
ALL = ItemOptions(keys=ITEM_KEYS, k=10)


@pytest.fixture(scope="module")
def blobs():
    return Blobs()


@pytest.fixture(scope="module")
def item(blobs):
    return make_item(blobs, "two-1", ALL)


def test_the_keys_are_those_of_the_design_with_their_shapes(item):
    assert ", ".join(item) == DESIGN
    v, f, ke = 162, 320, item["evals_even"].shape[0]
    expected = {
        "verts": (v, 3),
        "faces": (f, 3),
        "mass": (v,),
        "L": (v, v),
        "evals": (10,),
        "evecs": (v, 10),
        "evecs_trans": (10, v),
        "gradX": (v, v),
        "gradY": (v, v),
        "dist": (v, v),
        "corr": (v,),
        "group": (2, v),
        "evals_even": (ke,),
        "evecs_even": (v, ke),
        "evals_odd": (10 - ke,),
        "evecs_odd": (v, 10 - ke),
    }
    assert {key: tuple(value.shape) for key, value in item.items() if key != "name"} == expected
    assert all(item[key].layout == torch.sparse_coo for key in ("L", "gradX", "gradY"))
    assert all(item[key].dtype == torch.int64 for key in ("faces", "corr", "group"))


@pytest.mark.parametrize(
    ("keys", "made"),
    [
        ((), "name verts faces"),
        (("basis",), "name verts faces evals evecs evecs_trans"),
        (("gradX", "mass"), "name verts faces mass gradX"),
        (("group",), "name verts faces group"),
        (("operators", "evals_odd"), "name verts faces mass L evals_odd"),
    ],
)
def test_only_what_is_asked_for_is_made(blobs, item, keys, made):
    some = make_item(blobs, "two-1", replace(ALL, keys=keys))
    assert list(some) == made.split()
    for key, value in some.items():
        dense = (x.to_dense() if isinstance(x, torch.Tensor) else x for x in (value, item[key]))
        torch.testing.assert_close(*dense, rtol=1e-9, atol=1e-12) if key != "name" else None


@pytest.mark.parametrize("unit", [True, False])
@pytest.mark.parametrize("name", ["two-0", "flat-0"])
def test_matrix_mass_and_eigenpairs_belong_together_in_both_scales(blobs, name, unit):
    """``L phi = lambda M phi`` and ``Phi^T M Phi = I`` in the units of the item's own vertices."""
    item = make_item(blobs, name, replace(ALL, keys=("operators", "basis", "gradients"), unit_area=unit))
    mesh = Mesh(item["verts"], item["faces"])
    assert mesh.area == pytest.approx(1.0 if unit else blobs.mesh(name).area)
    assert torch.allclose(item["mass"], lumped_mass(mesh.verts, mesh.faces))
    assert torch.allclose(item["evecs_trans"] @ item["evecs"], torch.eye(10, dtype=torch.float64), atol=1e-9)
    left, right = item["L"] @ item["evecs"], item["mass"][:, None] * item["evecs"] * item["evals"]
    assert torch.allclose(left, right, atol=1e-8)
    assert torch.allclose(item["gradX"] @ item["evecs"], vertex_gradient(mesh).grad_x @ item["evecs"])


def test_vertices_are_not_moved_unless_scaled(blobs):
    assert torch.equal(
        make_item(blobs, "flat-0", ItemOptions((), unit_area=False))["verts"], grid(5, 4, 3.0, 2.0).verts
    )


def test_even_functions_are_constant_on_orbits_and_odd_ones_change_sign(item):
    mirror = item["group"][1]
    assert item["evals_odd"].shape[0] > 0
    assert torch.allclose(item["evecs_even"][mirror], item["evecs_even"], atol=1e-8)
    assert torch.allclose(item["evecs_odd"][mirror], -item["evecs_odd"], atol=1e-8)
    together = torch.cat([item["evals_even"], item["evals_odd"]]).sort().values
    assert torch.allclose(together, item["evals"], atol=1e-8)


def test_an_unknown_symmetry_is_the_identity_alone(blobs):
    item = make_item(blobs, "flat-0", replace(ALL, keys=("basis", "symmetry")))
    assert torch.equal(item["group"], torch.arange(30)[None])
    assert torch.equal(item["evecs_even"], item["evecs"])
    assert item["evecs_odd"].shape == (30, 0)


def test_distances_are_in_the_units_of_the_item(blobs, item):
    mesh = blobs.mesh("two-1")
    expected = distances(mesh, torch.arange(mesh.n_verts)) / mesh.area**0.5
    assert torch.allclose(item["dist"], expected, rtol=1e-6)
    with pytest.raises(ValueError, match=r"dist: copy has 162 vertices, so its distances take 0.0 GiB"):
        make_item(blobs, "two-1", replace(ALL, max_dist_bytes=8 * 162**2 - 1))


def test_real_numbers_have_the_wanted_type(blobs, item):
    single = make_item(blobs, "two-1", replace(ALL, dtype=torch.float32))
    for key, value in single.items():
        if key != "name":
            real = item[key].is_floating_point()
            assert value.dtype == (torch.float32 if real else torch.int64), key
            assert value.layout == item[key].layout
    assert torch.equal(single["evecs"], item["evecs"].float())  # computed in float64 all the same


def test_corr_goes_into_the_template_that_a_class_shares(blobs):
    assert torch.equal(template_corr(blobs, "two-0"), torch.arange(162))
    assert torch.equal(template_corr(blobs, "two-1"), blobs.copy.p2p_xy)
    verts = [blobs.mesh(name).verts[template_corr(blobs, name)] for name in ("two-0", "two-1")]
    assert torch.equal(*verts)
    assert torch.equal(template_corr(blobs, "eight-0"), torch.arange(42))


def test_truth_at_other_points_for_each_pair_is_no_template():
    class PerPair(Blobs):
        """Landmarks whose rows depend on the pair."""

        def shape_class(self, name):
            return "all"

        def truth(self, first, second):
            ids = torch.arange(3) + len(second)
            return Truth(ids, ids, "by hand")

    with pytest.raises(TruthError, match="no template shared by 'all': the truth from two-0 to two-1 and to eight-0"):
        template_corr(PerPair(), "eight-0")


def test_the_basis_comes_from_the_cache_in_the_units_of_the_item(blobs, item, tmp_path):
    options = replace(ALL, keys=("basis",), cache_dir=tmp_path)
    first = make_item(blobs, "two-1", options)
    report = cached_basis(blobs.mesh("two-1"), 10, cache_dir=tmp_path).report
    assert report.outcome == "read"
    again = make_item(blobs, "two-1", options)
    for key in ("evals", "evecs", "evecs_trans"):
        assert torch.equal(again[key], first[key])
        assert torch.allclose(again[key], item[key], atol=1e-9)


def test_a_basis_function_takes_the_place_of_the_cache(blobs, item):
    asked = []

    def basis(mesh, k):
        asked.append((mesh.n_verts, k))
        return mesh_basis(mesh, k)

    made = make_item(blobs, "two-1", replace(ALL, keys=("basis", "L"), basis=basis))
    assert asked == [(162, 10)]
    assert torch.allclose(made["evals"], item["evals"])


def test_what_cannot_be_asked_for_is_said(blobs):
    with pytest.raises(
        ValueError, match=r"keys: unknown 'frames'; allowed are name, .* and the groups shape, operators"
    ):
        ItemOptions(keys=("basis", "frames"))
    with pytest.raises(ValueError, match="k: given 0"):
        ItemOptions(k=0)
    with pytest.raises(ValueError, match=r"dtype: given torch.int64"):
        ItemOptions(dtype=torch.int64)
    with pytest.raises(ValueError, match="no shape 'cat0'"):
        make_item(blobs, "cat0")


def test_a_mesh_without_area_is_named():
    class Flat(Blobs):
        def mesh(self, name):
            return Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], name)

    with pytest.raises(MeshError, match="two-0: the surface has area 0"):
        make_item(Flat(), "two-0", ItemOptions(()))
