import pytest
import torch

from torchqm.evaluate.protocol import evaluate_errors, flip_rate
from torchqm.fmap.straight_errors import error_means, straight_errors


def _case():
    """Four points of a square of area 4, mirrored left and right."""
    verts = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0], [-1.0, 2, 0], [1.0, 2, 0]])
    group = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2]])
    return verts, torch.ones(4), group


def test_distances_to_the_truth_and_to_its_mirror_image():
    verts, mass, group = _case()
    p2p, truth, samples = torch.tensor([1, 0, 2, 0]), torch.tensor([0, 1, 2]), torch.tensor([0, 1, 3])
    errors = straight_errors(p2p, truth, samples, verts, mass, group)
    torch.testing.assert_close(errors, torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 2**0.5]]))
    scaled = straight_errors(p2p, truth, samples, 3 * verts, 9 * mass, group)
    torch.testing.assert_close(scaled, errors)


def test_padded_shapes_and_elements_change_nothing():
    verts, mass, group = _case()
    p2p, truth, samples = torch.tensor([1, 0, 2, 0]), torch.tensor([0, 1, 2]), torch.tensor([0, 1, 3])
    alone = straight_errors(p2p, truth, samples, verts, mass, group)
    more = torch.cat([group, torch.arange(4)[None]])
    wide = torch.cat([more, torch.tensor([4, 5]).expand(3, 2)], 1)
    pad = torch.nn.functional.pad
    both = straight_errors(
        pad(p2p, (0, 2))[None], pad(truth, (0, 1))[None], pad(samples, (0, 1))[None], pad(verts, (0, 0, 0, 2))[None],
        pad(mass, (0, 2))[None], wide[None],
    )  # fmt: skip
    torch.testing.assert_close(both[0, :2, :3], alone)
    weights = torch.tensor([0.5, 0.2, 0.3])
    padded = error_means(both, pad(weights, (0, 1))[None])
    for name, value in error_means(alone, weights).items():
        torch.testing.assert_close(padded[name][0], value)


@pytest.mark.parametrize("seed", range(4))
def test_means_and_flips_are_those_of_the_evaluation(seed):
    generator = torch.Generator().manual_seed(seed)
    errors, weights = torch.rand(3, 20, generator=generator), torch.rand(20, generator=generator)
    weights = weights / weights.sum()
    found = {name: value.item() for name, value in error_means(errors, weights).items()}
    flips = flip_rate(errors, weights=weights)
    wanted = {
        "plain_error": evaluate_errors(errors, "plain", weights).mean,
        "orbit_error": evaluate_errors(errors, "orbit", weights).mean,
        "flipped_map": float(flips.map),
        "flipped_points": flips.points,
    }
    assert found == pytest.approx(wanted, rel=1e-5)


def test_ids_out_of_range_are_named():
    verts, mass, group = _case()
    ids = torch.arange(4)
    with pytest.raises(ValueError, match="truth_xy: ids from 1 to 4"):
        straight_errors(ids, ids + 1, ids, verts, mass, group)
    with pytest.raises(ValueError, match="samples"):
        straight_errors(ids, ids, ids - 1, verts, mass, group)
