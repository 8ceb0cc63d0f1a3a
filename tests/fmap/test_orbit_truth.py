"""torchqm.fmap.orbit_truth and tables: orbits as sets, weights that sum to one, the soft minimum, checked tables."""

from math import log

import pytest
import torch
from references import loss_layers as twin
from references.unchecked import unchecked

from torchqm.fmap.orbit_truth import orbit_members, point_weights, soft_minimum
from torchqm.testing import gradcheck64


@pytest.mark.parametrize("table", [twin.dihedral(3), twin.dihedral(4), twin.cyclic(4), torch.arange(5)[None]])
def test_each_member_once(table):
    n = table.shape[1]
    for y, row in enumerate(orbit_members(torch.arange(n), table).tolist()):
        members = [z for z in row if z >= 0]
        assert members == sorted({int(g[y]) for g in table})
    assert orbit_members(torch.tensor([-1]), table).tolist() == [[-1] * table.shape[0]]


def test_padded_elements_and_vertices_are_no_members():
    small, large = twin.cyclic(2), twin.cyclic(3)
    table = torch.arange(8).expand(2, 3, 8).clone()
    table[0, :2, :6], table[1] = small, large
    mask = torch.tensor([[True, True, False], [True, True, True]])
    table[0, 2] = 7  # what padding holds does not matter
    truth = torch.tensor([[0, 5], [3, -1]])
    found = orbit_members(truth, table, mask)
    assert {y for y in found[0, 0].tolist() if y >= 0} == {int(g[0]) for g in small}
    assert torch.equal(found[1], orbit_members(truth[1], large))


def test_weights_are_shares_of_the_area():
    mass = torch.tensor([[1.0, 2.0, 5.0, 0.0], [1.0, 1.0, 1.0, 1.0]], dtype=torch.float64)
    truth = torch.tensor([[0, 1, -1, 3], [0, 0, 0, 0]])
    like = torch.zeros((), dtype=torch.float64)
    assert point_weights(truth, like, mass).tolist() == [[1 / 3, 2 / 3, 0, 0], [0.25] * 4]
    mask = torch.tensor([[True] * 4, [True, True, False, False]])
    assert point_weights(truth, like, None, None, mask).tolist() == [[1 / 3, 1 / 3, 0, 1 / 3], [0.5, 0.5, 0, 0]]
    samples = torch.tensor([[2, 0, 0], [3, 2, 1]])
    got = point_weights(torch.tensor([[7, 7, -1], [1, 1, 1]]), like, mass, samples)
    torch.testing.assert_close(got, torch.tensor([[5 / 6, 1 / 6, 0], [1 / 3] * 3], dtype=torch.float64))


def test_soft_minimum():
    values = torch.tensor([[3.0, 1.0, 2.0, 1.5]], dtype=torch.float64)
    assert soft_minimum(values, 0.0).item() == 1.0
    for t in (1e-3, 1e-30):  # of four, so t log 4 above the minimum
        assert soft_minimum(values, t).item() == pytest.approx(1 + t * log(4), abs=1e-12)
    assert soft_minimum(values, 1e6).item() == pytest.approx(values.mean().item(), rel=1e-6)
    expected = -0.4 * torch.exp(-values / 0.4).mean(-1).log()
    torch.testing.assert_close(soft_minimum(values, 0.4), expected)
    assert soft_minimum(torch.full((3,), 0.7, dtype=torch.float64), 0.2).item() == 0.7
    assert soft_minimum(torch.full((3,), 1e5), 1e-3).item() == 1e5  # exp(-1e8) is 0
    mask = torch.tensor([[True, False, True, False]])
    for t in (0.0, 0.4):
        torch.testing.assert_close(soft_minimum(values, t, mask), soft_minimum(values[:, ::2], t))
        gradcheck64(lambda v, t=t: soft_minimum(v, t, mask), values)


def test_bad_tables():
    truth, table = torch.tensor([0, 1]), torch.tensor([[0, 1, 2], [2, 1, 0]])
    with pytest.raises(ValueError, match="group_y: row 0 must be the identity"):
        orbit_members(truth, table.flip(0))
    with pytest.raises(ValueError, match=r"group_y: ids from 0 to 3 given, allowed are 0\.\.2"):
        orbit_members(truth, table + torch.tensor([[0], [1]]))
    with pytest.raises(ValueError, match=r"p2p_xy: ids from -2 to 1 given, allowed are 0\.\.2 and -1 \(none\)"):
        orbit_members(torch.tensor([-2, 1]), table)
    with pytest.raises(ValueError, match="group_mask: element 0, the identity, is real in each shape"):
        orbit_members(truth, table, torch.tensor([False, True]))
    with pytest.raises(ValueError, match=r"group_mask: shape \(3,\) given, expected \(G,\) with G = 2 as in group_y"):
        unchecked(orbit_members)(truth, table, torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"group_y: dtype torch\.float32 given, expected vertex ids"):
        unchecked(orbit_members)(truth, table.float())
    with pytest.raises(ValueError, match=r"temperature: -1\.0 given, expected a number from 0 on"):
        soft_minimum(torch.ones(2), -1.0)
    with pytest.raises(ValueError, match="temperature: 1e-31 given, expected 0 or a number from 1e-30 on"):
        soft_minimum(torch.ones(2), 1e-31)


def test_bad_points():
    like, truth = torch.zeros(()), torch.tensor([[0, 1], [-1, -1]])
    with pytest.raises(ValueError, match="p2p_xy: no point of shape 1 has both a truth and a positive area"):
        point_weights(truth, like)
    with pytest.raises(ValueError, match=r"mass_x: 1 of 4 entries are negative, the first at \(0, 1\)"):
        point_weights(truth, like, torch.tensor([[1.0, -1.0], [1.0, 1.0]]))
    with pytest.raises(ValueError, match=r"samples: ids from 0 to 2 given, allowed are 0\.\.1"):
        point_weights(truth, like, torch.ones(2, 2), torch.tensor([[0, 2], [0, 1]]))
    with pytest.raises(ValueError, match="p2p_xy: 2 points given, but mass_x has 3 vertices; samples must say"):
        point_weights(truth, like, torch.ones(2, 3))
    with pytest.raises(ValueError, match=r"truth_mask: dtype torch\.int64 given"):
        unchecked(point_weights)(truth, like, None, None, torch.ones(2, 2, dtype=torch.int64))
