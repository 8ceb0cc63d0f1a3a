import pytest

ROOT = "synthetic:kinds=biped,quadruped;poses=2;verts=500;triangulation=shared"


@pytest.fixture(scope="session")
def pairs():
    """A pair of bipeds and a pair of quadrupeds; their numbers of vertices differ, their symmetries are exact."""
    import torch

    from torchqm.data import ItemOptions, PairDataset, open_shapes

    options = ItemOptions(keys=("mass", "basis", "group", "gradients", "corr"), k=20, dtype=torch.float64)
    data = PairDataset(open_shapes(ROOT), "within-class+unordered", options=options)
    return [data[0], data[1]]
