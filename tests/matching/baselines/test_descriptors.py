"""torchqm.matching.baselines.descriptors: exact twins are found up to symmetry; nothing more is to be had."""

import pytest
import torch
from references.pairs import exact_pair, with_loose_vertices
from references.shapes import blob

from torchqm.matching import prepare
from torchqm.matching.baselines import NearestDescriptors


@pytest.mark.parametrize("kind", ["wks", "hks"])
def test_exact_twins(kind):
    """Without symmetry the exact map; with a reflection a point of the exact orbit, and both of them occur."""
    pair = exact_pair(1)
    found = NearestDescriptors(kind=kind).match(pair.x, pair.y).best
    assert float((found == pair.p2p_xy).double().mean()) > 0.99
    pair = exact_pair(2)
    found = NearestDescriptors(kind=kind).match(pair.x, pair.y).best
    direct = found == pair.p2p_xy
    assert float((direct | (found == pair.group_y.maps[1][pair.p2p_xy])).double().mean()) > 0.99
    assert 0.2 < float(direct.double().mean()) < 0.8


def test_on_another_pose_and_triangulation_it_is_poor(walkers):
    """What the others are measured against: see the bounds of their tests."""
    error = walkers.errors(NearestDescriptors().match(walkers.x, walkers.y).best).min()
    assert 0.07 < float(error) < 0.15


def test_vertices_of_no_face_are_never_chosen():
    mesh, _ = with_loose_vertices(blob(1).mesh, (0, 5, 300))
    y = prepare(mesh, 40)
    found = NearestDescriptors().match(y, y).best  # those of the source have the same signature: none
    assert not set(found.tolist()) & {0, 5, 300}
    assert torch.unique(found).numel() > 600


@pytest.mark.parametrize(("options", "message"), [({"kind": "shot"}, "wks, hks"), ({"n": 1}, "at least 2")])
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        NearestDescriptors(**options)
