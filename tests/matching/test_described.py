import gc

import pytest
import torch
from references.pairs import FAST, exact_pair, with_loose_vertices
from references.shapes import blob

from torchqm.fmap.threads import one_thread
from torchqm.matching import described, prepare
from torchqm.matching.described import pair_descriptors
from torchqm.matching.initial import shared_descriptors


@pytest.fixture(scope="module")
def shapes():
    return prepare(blob(2, 2).mesh, 20), prepare(blob(4, 2).mesh, 18)


@pytest.mark.parametrize("changes", [{}, {"descriptor": "hks"}, {"splits": 0}, {"k_max": 12}])
def test_equals_the_coefficients_of_the_shared_descriptors(shapes, changes):
    """The slow way makes all descriptors at all vertices first."""
    parameters = FAST.changed(k=10, **changes)
    x, y = shapes
    values = shared_descriptors([x.basis, y.basis], parameters)
    found = pair_descriptors(x, y, parameters)
    for mine, shape, slow in zip(found.coefficients, shapes, values, strict=True):
        torch.testing.assert_close(mine, shape.basis.truncate(10).coefficients(slow), atol=1e-10, rtol=1e-10)
    sign = torch.sign(y.mesh.verts[:, 0])
    wanted = y.basis.truncate(7).coefficients(sign[:, None] * values[1])
    torch.testing.assert_close(found.weighted(y, 7, sign), wanted, atol=1e-10, rtol=1e-10)


def test_vertices_without_area_say_nothing(shapes):
    mesh = blob(2).mesh
    loose, _ = with_loose_vertices(mesh, [5, 600])
    plain, more = (pair_descriptors(s, s, FAST.changed(k=8)) for s in (prepare(mesh, 20), prepare(loose, 20)))
    torch.testing.assert_close(more.coefficients[0].abs(), plain.coefficients[0].abs(), atol=1e-7, rtol=0)


def test_computed_once_and_turned_for_the_other_order(shapes, monkeypatch):
    x, y = shapes
    first = pair_descriptors(x, y, FAST.changed(k=9))
    monkeypatch.setattr(described, "_computed", lambda *_: pytest.fail("computed again"))
    assert pair_descriptors(x, y, FAST.changed(k=9)) is first
    turned = pair_descriptors(y, x, FAST.changed(k=9, commutativity=3.0))
    assert turned.coefficients[0] is first.coefficients[1]
    assert turned.coefficients[1] is first.coefficients[0]


def test_other_parameters_and_more_functions_are_computed_anew(shapes):
    x, y = shapes
    first = pair_descriptors(x, y, FAST.changed(k=9))
    assert (
        pair_descriptors(x, y, FAST.changed(k=9, splits=3)).coefficients[0].shape[1] != first.coefficients[0].shape[1]
    )
    more = pair_descriptors(x, y, FAST.changed(k=9), 14).coefficients[0]
    assert more.shape[0] == 14
    torch.testing.assert_close(more[:9], first.coefficients[0], atol=1e-12, rtol=1e-12)


def test_kept_no_longer_than_the_shapes():
    pair = exact_pair(2)
    x, y = pair.x, prepare(blob(4).mesh, 20)
    pair_descriptors(x, y, FAST)
    assert y in described._KEPT[x]
    before = len(described._KEPT[x])
    del y
    gc.collect()
    assert len(described._KEPT[x]) == before - 1


@pytest.mark.parametrize("threads", [1, 2])
def test_blocks_of_weighted_vertices_with_and_without_area(threads, monkeypatch):
    """By blocks of 100 vertices, the same to the last bit on any number of threads."""
    loose, _ = with_loose_vertices(blob(2).mesh, [5, 600])
    x = prepare(loose, 20)
    parameters = FAST.changed(k=8)
    found = pair_descriptors(x, x, parameters)
    sign = torch.sign(x.mesh.verts[:, 0])
    values = shared_descriptors([x.basis, x.basis], parameters)[0]
    wanted = x.basis.truncate(8).coefficients(sign[:, None] * values)
    monkeypatch.setattr(described, "_ROWS", 100)
    alone, before = found.weighted(x, 8, sign), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with one_thread():
            assert torch.equal(found.weighted(x, 8, sign), alone)
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(alone, wanted, atol=1e-10, rtol=1e-10)
