"""torchqm.fmap.orbit_consistency: zero for exactly the true maps, all of them with the right pairings."""

import pytest
import torch
from references import loss_layers as twin
from references.unchecked import unchecked

from torchqm.fmap.orbit_consistency import inner_pairings, orbit_consistency_fmap, orbit_consistency_points
from torchqm.spectral import SoftMap
from torchqm.testing import gradcheck64


class Copy:
    """A shape x with an exact group, and y, the same with other vertex numbers; all true maps are ``h o T``."""

    def __init__(self, table, seed=3):
        self.table_x, v = table, table.shape[1]
        self.p2p_xy = torch.randperm(v, generator=torch.Generator().manual_seed(seed))
        p2p_yx = self.p2p_xy.argsort()
        self.table_y = self.p2p_xy[table[:, p2p_yx]]
        self.eye = torch.eye(v, dtype=torch.float64)
        self.maps = [h[self.p2p_xy] for h in self.table_y]  # of each element h, x to y
        self.values = torch.randn(v, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        self.pairings = inner_pairings(twin.products(table))

    def fmap(self, p2p_xy):
        """Pull-back along the inverse: functions on x to functions on y, in the basis of all vertices."""
        return self.eye[p2p_xy.argsort()]

    def symmetries(self, table):
        return self.eye[table]

    def losses(self, p2p_xy, **options):
        v, (s_x, s_y) = len(p2p_xy), (self.symmetries(t) for t in (self.table_x, self.table_y))
        sparse, tables = SoftMap.from_p2p(p2p_xy, v), (self.table_x, self.table_y)
        return [
            float(loss)
            for loss in (
                orbit_consistency_fmap(self.fmap(p2p_xy), s_x, s_y, **options),
                orbit_consistency_points(self.eye[p2p_xy], *tables, **options),
                orbit_consistency_points(self.eye[p2p_xy], *tables, values_y=self.values, **options),
                orbit_consistency_points(sparse, *tables, values_y=self.values, **options),
            )
        ]


def central(products):
    return [h for h in range(len(products)) if torch.equal(products[h], products[:, h])]


@pytest.mark.parametrize("table", [twin.cyclic(4), twin.cyclic(5), twin.dihedral(3), twin.dihedral(4)])
def test_true_maps_and_wrong_ones(table):
    copy = Copy(table)
    centre = central(twin.products(table))
    assert len(copy.pairings) == len(table) // len(centre)
    for h, p2p in enumerate(copy.maps):
        assert copy.losses(p2p, pairings=copy.pairings) == [0.0] * 4
        plain = copy.losses(p2p)
        assert plain == [0.0] * 4 if h in centre else min(plain) > 0.1
    wrong = copy.p2p_xy.clone()
    wrong[:2] = wrong[:2].flip(0)
    assert min(copy.losses(wrong)) > 0.01
    assert min(copy.losses(wrong, pairings=copy.pairings)) > 0.01


def test_directions_on_one_map_that_is_no_involution():
    """Turning by one corner must go to turning by one corner: to the turn back it does not."""
    copy = Copy(twin.cyclic(5))
    back = torch.tensor([[0, 4, 3, 2, 1]])  # the pairing of each element with its inverse
    assert copy.losses(copy.p2p_xy) == [0.0] * 4
    assert min(copy.losses(copy.p2p_xy, pairings=back)) > 0.1
    both = torch.cat([torch.arange(5)[None], back])
    assert copy.losses(copy.p2p_xy, pairings=both) == [0.0] * 4


def test_pull_backs_or_their_inverses():
    copy = Copy(twin.dihedral(3))
    fmap = copy.fmap(copy.p2p_xy)
    s_x, s_y = copy.symmetries(copy.table_x), copy.symmetries(copy.table_y)
    assert orbit_consistency_fmap(fmap, s_x.mT, s_y.mT).item() == 0
    assert orbit_consistency_fmap(fmap, s_x.mT, s_y).item() > 1


def test_inner_pairings_are_conjugations():
    products = twin.products(twin.dihedral(3))
    pairings = inner_pairings(products)
    assert pairings[0].tolist() == list(range(6))
    assert len({tuple(row.tolist()) for row in pairings}) == 6
    for row in pairings:  # homomorphisms
        assert torch.equal(products[row][:, row], row[products])
    assert inner_pairings(twin.products(twin.cyclic(4))).tolist() == [[0, 1, 2, 3]]
    with pytest.raises(ValueError, match="products"):
        inner_pairings(torch.zeros(3, 3, dtype=torch.int64))


def soft_pair(k=None):
    copy = Copy(twin.dihedral(3))
    v = len(copy.p2p_xy)
    pi = torch.softmax(torch.randn(v, v, generator=torch.Generator().manual_seed(1), dtype=torch.float64), 1)
    mass = torch.rand(v, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    if k is None:
        return copy, pi, pi, mass
    weights, indices = pi.topk(k)
    soft = SoftMap(indices, weights, v)
    return copy, soft, soft.to_dense(), mass


@pytest.mark.parametrize("k", [None, 4])
def test_as_the_loops(k):
    copy, soft, dense, mass = soft_pair(k)
    expected = twin.consistency(dense, copy.values, copy.table_x, copy.table_y, mass.tolist())
    got = orbit_consistency_points(soft, copy.table_x, copy.table_y, copy.values, mass)
    assert got.item() == pytest.approx(expected, rel=1e-12)
    if k is None:
        got = orbit_consistency_points(soft, copy.table_x, copy.table_y, mass_x=mass)
        expected = twin.consistency(dense, copy.eye, copy.table_x, copy.table_y, mass.tolist())
        assert got.item() == pytest.approx(expected, rel=1e-12)


def test_vertex_maps_that_are_no_permutations():
    """Two vertices with one image: what moves along g still is the weight, and none is lost."""
    table = torch.tensor([[0, 1, 2], [2, 2, 0]])
    pi = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    expected = twin.consistency(pi, torch.eye(3, dtype=torch.float64), table, table, [1.0] * 3)
    assert orbit_consistency_points(pi, table, table).item() == pytest.approx(expected)


def test_a_batch_is_its_shapes():
    shapes = [Copy(twin.dihedral(3)), Copy(twin.cyclic(5))]  # 10 and 12 vertices, 6 and 5 elements
    v = 13
    pis, tables, mass, group_mask = (
        torch.zeros(2, v, v, dtype=torch.float64),
        [],
        torch.zeros(2, v),
        torch.zeros(2, 6).bool(),
    )
    generator = torch.Generator().manual_seed(0)
    for b, copy in enumerate(shapes):
        n, g = len(copy.p2p_xy), len(copy.table_x)
        pis[b, :n, :n] = torch.softmax(torch.randn(n, n, generator=generator, dtype=torch.float64), 1)
        mass[b, :n] = 1 + torch.rand(n, generator=generator)
        group_mask[b, :g] = True
        both = torch.arange(v).repeat(2, 6, 1)
        both[0, :g, :n], both[1, :g, :n] = copy.table_x, copy.table_y
        tables.append(both)
    table_x, table_y = torch.stack(tables, 1)
    values = torch.randn(2, v, 3, generator=generator, dtype=torch.float64)
    mass = mass.double()
    s_x, s_y = (torch.eye(v, dtype=torch.float64)[t] for t in (table_x, table_y))
    for b, copy in enumerate(shapes):  # padded functions are 0
        s_x[b, :, len(copy.p2p_xy) :], s_y[b, :, len(copy.p2p_xy) :] = 0, 0
    for options in (
        {},
        {"temperature": 0.5, "pairings": torch.stack([torch.arange(6), torch.tensor([0, 2, 1, 3, 4, 5])])},
    ):
        got = [
            orbit_consistency_points(pis, table_x, table_y, values, mass, group_mask, **options),
            orbit_consistency_points(pis, table_x, table_y, None, mass, group_mask, **options),
            orbit_consistency_fmap(pis, s_x, s_y, group_mask, **options),
        ]
        for b, copy in enumerate(shapes):
            n, g = len(copy.p2p_xy), len(copy.table_x)
            pi, own = pis[b, :n, :n], options
            if options:
                own = {**options, "pairings": options["pairings"][:, :g]}
            alone = [
                orbit_consistency_points(pi, copy.table_x, copy.table_y, values[b, :n], mass[b, :n], **own),
                orbit_consistency_points(pi, copy.table_x, copy.table_y, None, mass[b, :n], **own),
                orbit_consistency_fmap(pi, *(copy.symmetries(t) for t in (copy.table_x, copy.table_y)), **own),
            ]
            for batch, one in zip(got, alone, strict=True):
                torch.testing.assert_close(batch[b], one)


@pytest.mark.parametrize("temperature", [0.0, 0.5])
def test_gradients(temperature):
    copy, pi, _, mass = soft_pair()
    _, sparse, _, _ = soft_pair(3)
    options = {"temperature": temperature, "pairings": copy.pairings[:2]}
    tables = (copy.table_x, copy.table_y)
    s_x, s_y = (copy.symmetries(t) for t in tables)
    gradcheck64(lambda p: orbit_consistency_points(p, *tables, mass_x=mass, **options), pi)
    gradcheck64(
        lambda w, f: orbit_consistency_points(SoftMap(sparse.indices, w, len(mass)), *tables, f, mass, **options),
        sparse.weights,
        copy.values,
    )
    small = (torch.randn(3, 3, generator=torch.Generator().manual_seed(s), dtype=torch.float64) for s in range(5))
    a, b, c, d, e = small
    few = {"temperature": temperature, "pairings": torch.tensor([[0, 1], [1, 0]])}
    gradcheck64(lambda m, x, y: orbit_consistency_fmap(m, x, y, **few), a, torch.stack([b, c]), torch.stack([d, e]))
    assert s_x.shape == s_y.shape


def test_bad_input():
    table = torch.tensor([[0, 1, 2], [2, 1, 0]])
    pi, eye = torch.eye(3), torch.eye(3).expand(2, 3, 3)
    points, fmaps = unchecked(orbit_consistency_points), unchecked(orbit_consistency_fmap)
    for make, message in (
        (lambda: points(SoftMap.from_p2p(table[0], 3), table, table), "values_y: must be given with a sparse soft_xy"),
        (lambda: points(-pi, table, table), "soft_xy: 3 of 9 entries are negative"),
        (lambda: points(pi, table.flip(0), table), "group_x: row 0 must be the identity"),
        (lambda: points(pi, table, table[:1]), r"group_y: shape \(1, 3\) given, expected \(G, Y\) with G = 2"),
        (lambda: points(pi, table, table + table), r"group_y: ids from 0 to 4 given, allowed are 0\.\.2"),
        (lambda: points(pi, table, table, mass_x=torch.zeros(3)), "mass_x: each shape needs a vertex of positive area"),
        (lambda: points(pi, table, table, torch.full((3, 1), torch.nan)), "values_y: 3 of 3 entries are NaN"),
        (lambda: fmaps(pi, eye, eye[:1]), r"symmetry_y: shape \(1, 3, 3\) given, expected \(G, Ky, Ky\) with G = 2"),
        (lambda: fmaps(pi * torch.inf, eye, eye), "fmap_xy: 9 of 9 entries are NaN"),
        (lambda: fmaps(pi, eye, eye, pairings=torch.tensor([[0, 2]])), r"pairings: ids from 0 to 2 given, .* 0\.\.1"),
        (
            lambda: fmaps(pi, eye, eye, pairings=torch.tensor([0, 1])),
            r"pairings: shape \(2,\) given, expected \(A, 2\)",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            make()
