"""torchqm.fmap.orbit_loss: equal to the loops, invariant under the target's group, finite where there is no mass."""

from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import loss_layers as twin
from references.shapes import basis_of, renumbered
from references.unchecked import unchecked

from torchqm.fmap import p2p_to_fmap
from torchqm.fmap.orbit_loss import (
    assignment_orbit_loss,
    distance_orbit_loss,
    map_orbit_loss,
    spectral_orbit_loss,
)
from torchqm.fmap.orbit_truth import orbit_members
from torchqm.fmap.soft import soft_map
from torchqm.spectral import SoftMap
from torchqm.symmetry import symmetrized_basis
from torchqm.testing import gradcheck64

TABLES = {"D3": twin.dihedral(3), "D4": twin.dihedral(4), "C4": twin.cyclic(4), "C5": twin.cyclic(5)}


class Pair:
    """A random soft map to a shape with an exact group, distances, areas and a truth with gaps."""

    def __init__(self, table, n=9, k=None, seed=0, dtype=torch.float64):
        make = torch.Generator().manual_seed(seed)
        self.table, v = table, table.shape[1]
        self.logits = 2 * torch.randn(n, v, generator=make, dtype=torch.float64).to(dtype)
        dist = torch.rand(v, v, generator=make, dtype=torch.float64).to(dtype)
        self.dist = (dist + dist.T) * (1 - torch.eye(v, dtype=dtype))
        self.mass = torch.rand(n, generator=make, dtype=torch.float64).to(dtype)
        self.truth = torch.randint(-1, v, (n,), generator=make)
        self.truth[0] = 0
        self.even_y = torch.randn(v, 4, generator=make, dtype=torch.float64).to(dtype)[table].mean(0)
        self.even_x = torch.randn(n, 3, generator=make, dtype=torch.float64).to(dtype)
        self.fmap = torch.randn(4, 3, generator=make, dtype=torch.float64).to(dtype)
        dense = torch.softmax(self.logits, 1)
        self.soft = self.pi = dense
        if k is not None:
            values, indices = dense.topk(k, 1)
            self.soft = SoftMap(indices, values / values.sum(1, keepdim=True), v)
            self.pi = self.soft.to_dense()

    def losses(self):
        """Each loss as a function of the truth."""
        group = {"group_y": self.table, "mass_x": self.mass}
        return {
            "spectral": lambda t: spectral_orbit_loss(self.fmap, self.even_x, self.even_y, t, self.mass),
            "assignment": lambda t: assignment_orbit_loss(self.soft, t, **group),
            "distance": lambda t: distance_orbit_loss(self.soft, t, dist_y=self.dist, **group),
            "map": lambda t: map_orbit_loss(self.soft, t, temperature=0.3, **group),
            "map, hard": lambda t: map_orbit_loss(self.soft, t, temperature=0.0, **group),
            "map, distances": lambda t: map_orbit_loss(self.soft, t, dist_y=self.dist, temperature=0.3, **group),
        }


@pytest.mark.parametrize("k", [None, 5])
@pytest.mark.parametrize("name", ["D3", "C4"])
def test_as_the_loops(name, k):
    pair = Pair(TABLES[name], k=k)
    truth, mass = pair.truth.tolist(), pair.mass.tolist()
    assert min(truth) == -1
    expected = {
        "spectral": twin.spectral(pair.fmap, pair.even_x, pair.even_y, truth, mass),
        "assignment": twin.assignment(pair.pi, truth, mass, pair.table),
        "distance": twin.distance(pair.pi, truth, mass, pair.table, pair.dist),
        "map": twin.whole_map(pair.pi, truth, mass, pair.table, None, 0.3),
        "map, hard": twin.whole_map(pair.pi, truth, mass, pair.table, None, 0.0),
        "map, distances": twin.whole_map(pair.pi, truth, mass, pair.table, pair.dist, 0.3),
    }
    for form, loss in pair.losses().items():
        assert float(loss(pair.truth)) == pytest.approx(expected[form], rel=1e-12), form


@pytest.mark.parametrize("k", [None, 5])
def test_samples_and_masks(k):
    pair = Pair(TABLES["D4"], k=k)
    samples = torch.tensor([4, 0, 7, 2])
    chosen = torch.full_like(pair.truth, -1)
    chosen[samples] = torch.tensor([3, 0, 5, 6])
    few, mask = chosen[samples], torch.tensor([True, True, False, True])
    chosen[7] = -1
    points = {"samples": samples, "truth_mask": mask, "mass_x": pair.mass}
    group = {"group_y": pair.table}
    few_losses = [
        spectral_orbit_loss(pair.fmap, pair.even_x, pair.even_y, few, **points),
        assignment_orbit_loss(pair.soft, few, **group, **points),
        distance_orbit_loss(pair.soft, few, **group, dist_y=pair.dist, **points),
        map_orbit_loss(pair.soft, few, **group, temperature=0.3, **points),
    ]
    for got, (form, loss) in zip(few_losses, list(pair.losses().items())[:4], strict=True):
        torch.testing.assert_close(got, loss(chosen), msg=form)
    members = orbit_members(few, pair.table)
    rows = torch.stack([pair.dist[[y for y in row if y >= 0]].amin(0) for row in members.tolist()])
    got = distance_orbit_loss(pair.soft, few, orbit_dist=rows, **points)
    torch.testing.assert_close(got, few_losses[2])


@given(
    name=st.sampled_from(sorted(TABLES)),
    k=st.sampled_from([None, 4]),
    seed=st.integers(0, 1000),
    data=st.data(),
)
def test_another_of_the_true_answers_costs_the_same(name, k, seed, data):
    pair = Pair(TABLES[name], k=k, seed=seed)
    n = len(pair.truth)
    g = data.draw(st.integers(0, len(pair.table) - 1), label="element")
    each = torch.tensor(data.draw(st.lists(st.integers(0, len(pair.table) - 1), min_size=n, max_size=n)))
    known = pair.truth >= 0
    moved = torch.where(known, pair.table[g][pair.truth.clamp_min(0)], -1)
    mixed = torch.where(known, pair.table[each, pair.truth.clamp_min(0)], -1)
    for form, loss in pair.losses().items():
        value = loss(pair.truth)
        torch.testing.assert_close(loss(moved), value, rtol=1e-12, atol=1e-12, msg=form)
        if form in ("assignment", "distance"):
            assert torch.equal(loss(moved), value)
            assert torch.equal(loss(mixed), value)
        elif form == "spectral":
            torch.testing.assert_close(loss(mixed), value, rtol=1e-12, atol=1e-12)


def test_the_map_form_wants_one_element_for_all_points():
    table = TABLES["D3"]
    n = table.shape[1]
    truth, dist = torch.arange(n), Pair(table).dist
    for g in range(6):
        image = torch.eye(n, dtype=torch.float64)[table[g]]
        assert map_orbit_loss(image, truth, table, temperature=0.0).item() == 0
        assert map_orbit_loss(image, truth, table, dist, temperature=0.0).item() == 0
    mixed = torch.where(truth < n // 2, table[1], table[2])
    image = torch.eye(n, dtype=torch.float64)[mixed]
    assert assignment_orbit_loss(image, truth, table).item() == 0
    assert distance_orbit_loss(image, truth, table, dist).item() == 0
    assert map_orbit_loss(image, truth, table, temperature=0.0).item() > 1
    assert map_orbit_loss(image, truth, table, dist, temperature=0.0).item() > 0.01


def test_the_even_map_of_an_isometry(mirror_blob):
    """On a real shape: zero for the truth and for its mirror image, not for a map that is off."""
    copy = renumbered(mirror_blob, 20)
    even_x = symmetrized_basis(basis_of(mirror_blob.mesh, 20), mirror_blob.group).even
    even_y = symmetrized_basis(copy.basis, copy.shape.group).even
    fmap = p2p_to_fmap(copy.p2p_yx, even_x, even_y)
    for truth in copy.shape.group.maps[:, copy.p2p_xy]:
        assert spectral_orbit_loss(fmap, even_x.evecs, even_y.evecs, truth, even_x.mass).item() < 1e-20
    wrong = copy.p2p_xy.roll(1)
    assert spectral_orbit_loss(fmap, even_x.evecs, even_y.evecs, wrong, even_x.mass).item() > 0.1


def test_a_fixed_point_counts_once():
    table = torch.tensor([[0, 1, 2], [2, 1, 0]])
    pi = torch.tensor([[0.25, 0.5, 0.25]], dtype=torch.float64)
    sparse = SoftMap(torch.tensor([[1, 0]]), torch.tensor([[0.5, 0.5]], dtype=torch.float64), 3)
    for soft in (pi, sparse):
        assert assignment_orbit_loss(soft, torch.tensor([1]), table).exp().item() == pytest.approx(2, abs=1e-9)
    got = assignment_orbit_loss(pi.log(), torch.tensor([1]), table, log_weights=True)
    assert got.exp().item() == pytest.approx(2, abs=1e-12)


def padded(values, *shape):
    out = values.new_zeros(shape)
    out[tuple(slice(size) for size in values.shape)] = values
    return out


@pytest.mark.parametrize("k", [None, 4])
def test_a_batch_is_its_shapes(k):
    pairs = [Pair(TABLES["D3"], 7, k), Pair(TABLES["C5"], 9, k, seed=1)]  # y of 10 and 12 vertices
    g, v, n = 6, 13, 9
    table = torch.arange(v).repeat(2, g, 1)
    group_mask = torch.zeros(2, g, dtype=torch.bool)
    for b, pair in enumerate(pairs):
        table[b, : pair.table.shape[0], : pair.table.shape[1]] = pair.table
        group_mask[b, : pair.table.shape[0]] = True
    mass = torch.stack([padded(p.mass, n) for p in pairs])
    truth = torch.stack([padded(p.truth, n) for p in pairs])
    dist = torch.stack([padded(p.dist, v, v) for p in pairs])
    if k is None:
        soft = torch.stack([padded(p.pi, n, v) for p in pairs])
    else:
        soft = SoftMap(
            *(
                torch.stack([padded(t, n, k) for t in ts])
                for ts in zip(*((p.soft.indices, p.soft.weights) for p in pairs), strict=True)
            ),
            v,
        )
    points = {"mass_x": mass, "group_mask": group_mask}
    got = {
        "spectral": spectral_orbit_loss(
            torch.stack([p.fmap for p in pairs]),
            torch.stack([padded(p.even_x, n, 3) for p in pairs]),
            torch.stack([padded(p.even_y, v, 4) for p in pairs]),
            truth,
            mass,
        ),
        "assignment": assignment_orbit_loss(soft, truth, table, **points),
        "distance": distance_orbit_loss(soft, truth, table, dist, **points),
        "map": map_orbit_loss(soft, truth, table, temperature=0.3, **points),
        "map, hard": map_orbit_loss(soft, truth, table, temperature=0.0, **points),
        "map, distances": map_orbit_loss(soft, truth, table, dist, temperature=0.3, **points),
    }
    for form, values in got.items():
        torch.testing.assert_close(values, torch.stack([p.losses()[form](p.truth) for p in pairs]), msg=form)


@pytest.mark.parametrize("k", [None, 5])
def test_gradients(k):
    pair = Pair(TABLES["D3"], 4, k)
    table, truth, mass = pair.table, pair.truth, pair.mass
    fns = [
        partial(assignment_orbit_loss, p2p_xy=truth, group_y=table, mass_x=mass),
        partial(map_orbit_loss, p2p_xy=truth, group_y=table, mass_x=mass, temperature=0.3),
        partial(map_orbit_loss, p2p_xy=truth, group_y=table, mass_x=mass, temperature=0.0),
    ]

    def soft(weights):
        return weights if k is None else SoftMap(pair.soft.indices, weights, pair.soft.n_targets)

    weights = pair.soft if k is None else pair.soft.weights
    for fn in fns:
        gradcheck64(lambda w, fn=fn: fn(soft(w)), weights + 0.01)  # finite differences must not leave [0, inf)
    dist = pair.dist + 0.1
    gradcheck64(lambda w, d: distance_orbit_loss(soft(w), truth, table, d, mass_x=mass), weights, dist)
    gradcheck64(lambda w, d: map_orbit_loss(soft(w), truth, table, d, 0.3, mass), weights, dist)
    gradcheck64(lambda w, d: distance_orbit_loss(soft(w), truth[:4], orbit_dist=d, mass_x=mass), weights, dist[:4])


def test_gradients_of_logarithms_and_of_the_spectral_form():
    pair = Pair(TABLES["D4"], 4)
    table, truth, mass = pair.table, pair.truth, pair.mass
    gradcheck64(
        lambda x: assignment_orbit_loss(torch.log_softmax(x, 1), truth, table, mass, log_weights=True), pair.logits
    )
    gradcheck64(
        lambda x: map_orbit_loss(torch.log_softmax(x, 1), truth, table, mass_x=mass, log_weights=True), pair.logits
    )
    gradcheck64(lambda c, x, y: spectral_orbit_loss(c, x, y, truth, mass), pair.fmap, pair.even_x, pair.even_y)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_mass_on_the_orbit(dtype):
    table = torch.tensor([[0, 1, 2, 3], [1, 0, 2, 3]])
    truth = torch.tensor([0])
    bottom = -torch.tensor(1e-12, dtype=torch.float64).log().item()
    dense = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=dtype, requires_grad=True)
    weights = torch.tensor([[1.0, 0.0]], dtype=dtype, requires_grad=True)
    on_it = SoftMap(torch.tensor([[2, 1]]), weights, 4)
    for soft, leaf, at in ((dense, dense, (0, 1)), (on_it, weights, (0, 1))):
        for fn in (assignment_orbit_loss, map_orbit_loss):
            loss = fn(soft, truth, table)
            assert loss.item() == pytest.approx(bottom, rel=1e-3 if fn is assignment_orbit_loss else 0.01)
            (grad,) = torch.autograd.grad(loss, leaf)
            assert bool(torch.isfinite(grad).all())
            assert grad[at] < -1e10
    off_it = SoftMap(torch.tensor([[2, 3]]), weights, 4)
    loss = assignment_orbit_loss(off_it, truth, table)
    assert loss.item() == pytest.approx(bottom, rel=1e-6)
    assert not torch.autograd.grad(loss, weights)[0].any()


def test_a_gradient_from_any_distance():
    """Weights that underflow: logarithms pull, and so do neighbours that were made to include the orbit."""
    table = torch.tensor([[0, 1, 2, 3], [1, 0, 2, 3]])
    truth = torch.tensor([0])
    logits = torch.tensor([[-900.0, -1000.0, 0.0, 0.0]], requires_grad=True)
    loss = assignment_orbit_loss(torch.log_softmax(logits, 1), truth, table, log_weights=True)
    assert loss.item() == pytest.approx(900 + torch.tensor(2.0).log().item())
    (grad,) = torch.autograd.grad(loss, logits)
    torch.testing.assert_close(grad, torch.tensor([[-1.0, 0.0, 0.5, 0.5]]))
    impossible = torch.tensor([[-torch.inf, -torch.inf, 0.0, -torch.inf]], requires_grad=True)
    loss = assignment_orbit_loss(impossible, truth, table, log_weights=True)
    (grad,) = torch.autograd.grad(loss, impossible)
    assert bool(torch.isfinite(loss) & torch.isfinite(grad).all())

    features, targets = torch.tensor([[4.0]], requires_grad=True), torch.tensor([[-1.0], [-2.0], [1.0], [2.0]])
    far = soft_map(features, targets, 1.0, 2)
    assert torch.autograd.grad(assignment_orbit_loss(far, truth, table), features)[0].item() == 0
    with_orbit = soft_map(features, targets, 1.0, 3, include=orbit_members(truth, table))
    assert torch.autograd.grad(assignment_orbit_loss(with_orbit, truth, table), features)[0].item() > 1


def test_at_the_truth():
    table = TABLES["D4"]
    n = table.shape[1]
    pair = Pair(table)
    for dtype in (torch.float32, torch.float64):
        exact = torch.eye(n, dtype=dtype, requires_grad=True)
        dist = pair.dist.to(dtype).requires_grad_()
        for loss in (
            assignment_orbit_loss(exact, torch.arange(n), table),
            distance_orbit_loss(exact, torch.arange(n), table, dist),
            distance_orbit_loss(SoftMap.from_p2p(torch.arange(n), n, dtype), torch.arange(n), table, dist),
            map_orbit_loss(exact, torch.arange(n), table, dist, 0.0),
        ):
            assert loss.item() == 0
            if loss.requires_grad:
                grads = torch.autograd.grad(loss, (exact, dist), allow_unused=True)
                assert all(g is None or bool(torch.isfinite(g).all()) for g in grads)


def test_a_sparse_map_looks_up_its_neighbours_only(monkeypatch):
    seen = []
    gather = torch.gather
    monkeypatch.setattr(torch, "gather", lambda *a: seen.append(gather(*a)) or seen[-1])
    pair = Pair(TABLES["C5"], 200, k=3)
    for loss in (pair.losses()["distance"], pair.losses()["map, distances"]):
        loss(pair.truth)
    n, v = 200, pair.table.shape[1]
    assert max(t.numel() for t in seen) <= n * 5 < n * v


@pytest.mark.parametrize("k", [None, 5])
def test_vmap(k):
    pair = Pair(TABLES["D3"], k=k)
    truth = torch.stack([pair.truth, pair.truth.flip(0)])
    for form, loss in pair.losses().items():
        expected = torch.stack([loss(t) for t in truth])
        torch.testing.assert_close(torch.func.vmap(loss)(truth), expected, msg=form)


PI, TABLE, TRUTH = torch.full((2, 3), 1 / 3), torch.tensor([[0, 1, 2], [2, 1, 0]]), torch.tensor([0, 1])


@pytest.mark.parametrize(
    ("fn", "change", "message"),
    [
        (assignment_orbit_loss, {"soft_xy": -PI}, r"soft_xy: 6 of 6 entries are negative, the first at \(0, 0\)"),
        (assignment_orbit_loss, {"soft_xy": PI * torch.nan}, "soft_xy: 6 of 6 entries are NaN"),
        (assignment_orbit_loss, {"soft_xy": PI * torch.inf, "log_weights": True}, "soft_xy: 6 of 6 entries are NaN"),
        (assignment_orbit_loss, {"soft_xy": PI[:, :2]}, r"group_y: shape \(2, 3\) given, expected \(G, Y\) with Y = 2"),
        (assignment_orbit_loss, {"soft_xy": SoftMap.from_p2p(TRUTH, 4)}, r"group_y: .* with Y = 4 as in soft_xy"),
        (
            assignment_orbit_loss,
            {"soft_xy": SoftMap.from_p2p(TRUTH, 1)},
            r"soft_xy: ids from 0 to 1 given, allowed are 0\.\.0",
        ),
        (
            assignment_orbit_loss,
            {"soft_xy": SoftMap.from_p2p(TRUTH, 3), "log_weights": True},
            "log_weights: only for a dense",
        ),
        (assignment_orbit_loss, {"p2p_xy": torch.tensor([0, 3])}, r"p2p_xy: ids from 0 to 3 given, allowed are 0\.\.2"),
        (
            assignment_orbit_loss,
            {"p2p_xy": torch.tensor([0])},
            r"p2p_xy: shape \(1,\) given, expected \(X,\) with X = 2",
        ),
        (assignment_orbit_loss, {"eps": 0.0}, "eps: 0.0 given, expected a positive number below 1"),
        (
            assignment_orbit_loss,
            {"samples": torch.tensor([0, 2])},
            r"samples: ids from 0 to 2 given, allowed are 0\.\.1",
        ),
        (assignment_orbit_loss, {"mass_x": torch.tensor([1.0, -1.0])}, "mass_x: 1 of 2 entries are negative"),
        (assignment_orbit_loss, {"group_y": TABLE.flip(0)}, "group_y: row 0 must be the identity"),
        (distance_orbit_loss, {"dist_y": -torch.ones(3, 3)}, "dist_y: 9 of 9 entries are negative"),
        (
            distance_orbit_loss,
            {"dist_y": torch.ones(3, 2)},
            r"dist_y: shape \(3, 2\) given, expected \(Y, Y\) with Y = 3",
        ),
        (distance_orbit_loss, {}, "dist_y, orbit_dist: exactly one of them must be given"),
        (distance_orbit_loss, {"dist_y": torch.ones(3, 3), "group_y": None}, "group_y: must be given with dist_y"),
        (distance_orbit_loss, {"orbit_dist": torch.ones(3, 3), "group_y": None}, r"orbit_dist: shape \(3, 3\) given"),
        (distance_orbit_loss, {"orbit_dist": torch.ones(2, 3)}, "group_y: given with orbit_dist, which holds"),
        (
            distance_orbit_loss,
            {"orbit_dist": torch.ones(2, 3), "group_y": None, "group_mask": torch.ones(2, dtype=torch.bool)},
            "group_mask: given with orbit_dist, which holds",
        ),
        (map_orbit_loss, {"temperature": -1.0}, "temperature: -1.0 given"),
        (map_orbit_loss, {"dist_y": torch.ones(3, 3), "log_weights": True}, "log_weights: distances need the weights"),
        (map_orbit_loss, {"p2p_xy": torch.tensor([-1, -1])}, "p2p_xy: no point of shape 0 has both a truth"),
    ],
)
def test_bad_input(fn, change, message):
    given = {"soft_xy": PI, "p2p_xy": TRUTH, "group_y": TABLE} | change
    with pytest.raises(ValueError, match=message):
        unchecked(fn)(**given)


def test_bad_input_of_the_spectral_form():
    good = {"fmap_even": torch.ones(2, 2), "evecs_even_x": torch.ones(2, 2), "evecs_even_y": torch.ones(3, 2)}
    for change, message in (
        ({"fmap_even": torch.ones(3, 2)}, r"evecs_even_y: shape \(3, 2\) given, expected \(Y, Ky\) with Ky = 3"),
        ({"fmap_even": torch.full((2, 2), torch.inf)}, "fmap_even: 4 of 4 entries are NaN or infinite"),
        ({"p2p_xy": torch.tensor([0, 3])}, r"p2p_xy: ids from 0 to 3 given, allowed are 0\.\.2"),
    ):
        with pytest.raises(ValueError, match=message):
            unchecked(spectral_orbit_loss)(**({**good, "p2p_xy": TRUTH} | change))
