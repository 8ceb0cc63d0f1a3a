import pickle

import pytest
import torch

from torchqm.data import ItemOptions, collate, make_item, open_shapes
from torchqm.learn import LearnedDescriptors, MatchNet, NetOptions
from torchqm.matching import MatchError, prepare

ROOT = "synthetic:kinds=biped,quadruped;poses=2;verts=500;triangulation=shared"
SMALL = {"k": 20, "signature": 16, "channels": 12, "width": 24}


@pytest.fixture(scope="module")
def shape():
    """A shape of a data set, prepared with more functions than the network wants, in another size."""
    shapes = open_shapes(ROOT)
    return shapes, prepare(shapes.mesh(shapes.names[1]), 50)


KINDS = {"mlp": {}, "diffusion": {"network": "diffusion"}, "all": {"inputs": ("wks", "xyz", "normals", "hks")}}


@pytest.mark.parametrize("more", KINDS.values(), ids=KINDS)
def test_they_are_what_the_network_makes_of_the_item_that_it_was_trained_on(shape, more):
    shapes, prepared = shape
    torch.manual_seed(0)
    net = MatchNet(NetOptions(**SMALL, **more, dropout=0.5))
    item = make_item(shapes, shapes.names[1], ItemOptions(keys=net.options.keys, k=20, dtype=torch.float32))
    values = LearnedDescriptors(net)(prepared)
    assert values.dtype == torch.float64
    assert net.training  # as it was
    with torch.no_grad():
        wanted = net.eval().describe(collate([item]))[0]
    torch.testing.assert_close(values, wanted.double(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(values.norm(dim=1), torch.ones(len(values), dtype=torch.float64), rtol=1e-5, atol=0)


def test_their_name_is_that_of_the_weights(tmp_path):
    first, same, other = (MatchNet(NetOptions(**SMALL)) for _ in range(3))
    same.load_state_dict(first.state_dict())
    names = [repr(LearnedDescriptors(net)) for net in (first, same, other)]
    assert names[0] == names[1] != names[2]
    assert repr(pickle.loads(pickle.dumps(LearnedDescriptors(first)))) == names[0]


def test_too_few_functions_are_named(shape):
    with pytest.raises(MatchError, match=r"pose1: 50 eigenfunctions are there, .* trained with 60"):
        LearnedDescriptors(MatchNet(NetOptions(k=60, channels=8)))(shape[1])
