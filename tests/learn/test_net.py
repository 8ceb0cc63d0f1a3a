from itertools import pairwise

import pytest
import torch

from torchqm.data import collate
from torchqm.learn import MatchNet, NetOptions
from torchqm.nn import InputFeatures

SMALL = {"k": 20, "signature": 16, "channels": 12, "width": 24, "odd_pairs": 20}
KINDS = [
    ("functional_map", "none", "spectral"),
    ("functional_map", "plain", "spectral"),
    ("functional_map", "plain", "assignment"),
    ("functional_map", "orbit", "assignment"),
    ("quotient", "none", "spectral"),
    ("quotient", "orbit", "spectral"),
    ("quotient", "orbit", "assignment"),
    ("quotient+odd", "none", "spectral"),
    ("quotient+odd", "orbit", "spectral"),
    ("quotient+odd", "orbit", "assignment"),
]


def net_of(setup, supervision="none", truth_form="spectral", **more):
    torch.manual_seed(0)
    options = NetOptions(setup=setup, supervision=supervision, truth_form=truth_form, **(SMALL | more))
    return MatchNet(options).double()


def steps(net, batch, n=4):
    optimizer, losses = torch.optim.Adam(net.parameters(), 3e-3), []
    for _ in range(n):
        terms = net.losses(batch)
        loss = sum(terms.values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append({name: value.item() for name, value in (terms | {"loss": loss}).items()})
    return losses


@pytest.mark.parametrize(("setup", "supervision", "truth_form"), KINDS)
def test_every_setup_lowers_its_loss(setup, supervision, truth_form, pairs):
    losses = steps(net_of(setup, supervision, truth_form), collate(pairs))
    for name in ("loss", *(() if supervision == "none" else ("l_truth",))):
        assert all(after[name] < before[name] for before, after in pairwise(losses)), name
    assert set(losses[0]) == {"l_bij", "l_orth", "l_lap", "l_align", "loss"} | (
        set() if supervision == "none" else {"l_truth"}
    )


@pytest.mark.parametrize("network", ["mlp", "diffusion"])
@pytest.mark.parametrize(("setup", "supervision", "truth_form"), [KINDS[2], KINDS[5], KINDS[9]])
def test_a_padded_batch_is_the_mean_of_its_pairs(setup, supervision, truth_form, network, pairs):
    net = net_of(setup, supervision, truth_form, network=network)
    batch, each = collate(pairs), [collate([pair]) for pair in pairs]
    assert not batch["first"]["verts_mask"].all()
    together = net.losses(batch)
    alone = [net.losses(one) for one in each]
    for name, value in together.items():
        torch.testing.assert_close(value, sum(terms[name] for terms in alone) / 2, rtol=1e-8, atol=1e-8)
    grads = torch.autograd.grad(sum(together.values()), list(net.parameters()))
    single = torch.autograd.grad(sum(sum(terms.values()) for terms in alone) / 2, list(net.parameters()))
    for found, wanted in zip(grads, single, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-8)
    errors = net.errors(batch, net(batch["first"], batch["second"]))
    for b, one in enumerate(each):
        for name, value in net.errors(one, net(one["first"], one["second"])).items():
            if setup == "quotient" and name != "orbit_error":
                continue  # which point of an orbit comes back is for rounding to say
            torch.testing.assert_close(errors[name][b], value[0])


def without_truth(pair):
    none = torch.zeros(0, dtype=torch.long)
    return pair | {side: pair[side] | {"corr": none} for side in ("first", "second")}


TRUTH_ALONE = dict.fromkeys(("w_bij", "w_orth", "w_lap", "w_align"), 0.0)
SUPERVISED = [kind for kind in KINDS if kind[1] != "none"]


@pytest.mark.parametrize(("setup", "supervision", "truth_form"), SUPERVISED)
def test_what_a_pair_without_a_truth_adds_is_what_it_adds_alone(setup, supervision, truth_form, pairs):
    """So two processes with a pair each have, in the mean, the gradients of one with both."""
    net = net_of(setup, supervision, truth_form)
    parts = [pairs[0], without_truth(pairs[1])]
    losses = [net.losses(collate(given)) for given in (parts, parts[:1], parts[1:])]
    both, first, second = losses
    assert set(both) == set(first) == set(second)
    assert second["l_truth"].item() == 0.0
    torch.testing.assert_close(both["l_truth"], first["l_truth"] / 2, rtol=1e-9, atol=0.0)
    grads = [torch.autograd.grad(sum(terms.values()), list(net.parameters())) for terms in losses]
    for found, one, other in zip(*grads, strict=True):
        torch.testing.assert_close(found, (one + other) / 2, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("setup", "supervision", "truth_form"), SUPERVISED)
def test_without_any_truth_every_weight_still_has_a_gradient_and_it_is_zero(setup, supervision, truth_form, pairs):
    net = net_of(setup, supervision, truth_form, **TRUTH_ALONE)
    found = {}
    for name, given in (("with", pairs[:1]), ("without", [without_truth(pairs[0])])):
        net.zero_grad()
        sum(net.losses(collate(given)).values()).backward()
        found[name] = {key: value.grad for key, value in net.named_parameters() if value.grad is not None}
    assert found["with"].keys() == found["without"].keys() != set()  # else the other processes wait for ever
    assert all(float(value.abs().max()) == 0.0 for value in found["without"].values())
    assert any(float(value.abs().max()) > 0.0 for value in found["with"].values())


def test_errors_are_those_of_the_pairs_with_a_truth(pairs):
    net = net_of("quotient+odd")
    errors = []
    for given in ([without_truth(pairs[0]), pairs[1]], pairs, [without_truth(pair) for pair in pairs]):
        batch = collate(given)
        errors.append(net.errors(batch, net(batch["first"], batch["second"])))
    some, every, none = errors
    for name, value in some.items():
        assert torch.equal(value, every[name][1:])
        assert none[name].shape == (0,)


def test_a_batch_without_truths_in_it_at_all_is_named(pairs):
    batch = collate([{side: {k: v for k, v in pair[side].items() if k != "corr"} for side in ("first", "second")}
                     for pair in pairs])  # fmt: skip
    with pytest.raises(ValueError, match="corr: the pairs have none, but a supervision needs it"):
        net_of("quotient", "orbit").losses(batch)


def swapped(pair):
    second = pair["second"]
    return pair | {"second": second | {"corr": second["group"][1][second["corr"]]}}


@pytest.mark.parametrize(("setup", "supervision", "truth_form"), [kind for kind in KINDS if kind[1] != "none"])
def test_swapped_truths_change_the_plain_loss_only(setup, supervision, truth_form, pairs):
    net = net_of(setup, supervision, truth_form, inputs=("wks", "xyz"))  # features of even inputs cannot tell
    with torch.no_grad():
        true, wrong = (net.losses(collate(list(given)))["l_truth"].item() for given in (pairs, map(swapped, pairs)))
    assert (abs(wrong - true) < 1e-9 * true) == (supervision == "orbit")
    assert (abs(wrong - true) > 1e-3 * true) == (supervision == "plain")


ASSIGNMENTS = [kind for kind in SUPERVISED if kind[2] == "assignment"]


@pytest.mark.parametrize(("setup", "supervision", "truth_form"), ASSIGNMENTS)
def test_training_on_swapped_truths_is_the_same_to_the_last_bit_up_to_symmetry_only(
    setup, supervision, truth_form, pairs
):
    """The symmetries of these shapes are exact; then no bit of a gradient tells a truth from its mirror image."""
    found = []
    for given in (pairs, [swapped(pairs[0]), pairs[1]]):
        net = net_of(setup, supervision, truth_form, inputs=("wks", "xyz"), **TRUTH_ALONE)
        net.losses(collate(given))["l_truth"].backward()
        first = [p.grad.clone() for p in net.parameters() if p.grad is not None]
        steps(net, collate(given), 3)
        found.append((first, list(net.state_dict().values())))
    (true_grads, true_net), (wrong_grads, wrong_net) = found
    assert any(float(grad.abs().max()) > 0 for grad in true_grads)
    same = [all(torch.equal(a, b) for a, b in zip(*two, strict=True))
            for two in ((true_grads, wrong_grads), (true_net, wrong_net))]  # fmt: skip
    assert same == [supervision == "orbit"] * 2


def test_the_joined_map_is_direct_and_the_full_one_is_not(pairs):
    batch = collate(pairs)
    errors = {}
    for setup in ("functional_map", "quotient+odd"):
        net = net_of(setup)
        steps(net, batch, 6)
        errors[setup] = net.errors(batch, net(batch["first"], batch["second"]))
    odd, full = errors["quotient+odd"], errors["functional_map"]
    assert odd["flipped_map"].sum() == 0
    assert odd["flipped_points"].max() < 0.1 < full["flipped_points"].min()
    assert (odd["plain_error"] < full["plain_error"]).all()


def test_one_shape_without_symmetry_changes_nothing_for_the_others(pairs):
    plain = {side: pairs[1][side] | {"group": pairs[1][side]["group"][:1]} for side in ("first", "second")}
    net = net_of("quotient+odd")
    mixed = net.losses(collate([{side: pairs[0][side] for side in ("first", "second")}, plain]))
    alone = [net.losses(collate([pair])) for pair in (pairs[0], plain)]
    for name, value in mixed.items():
        torch.testing.assert_close(value, sum(terms[name] for terms in alone) / 2, rtol=1e-8, atol=1e-8)


def test_shapes_without_symmetry_have_an_empty_odd_block(pairs):
    trivial = [
        {side: pair[side] | {"group": pair[side]["group"][:1]} for side in ("first", "second")} for pair in pairs
    ]
    net = net_of("quotient+odd")
    batch = collate(trivial)
    matched = net(batch["first"], batch["second"])
    assert matched.maps.fmaps_xy[1].numel() == 0
    loss = sum(net.losses(batch, matched).values())
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())
    full = net_of("functional_map").losses(batch)
    torch.testing.assert_close(net.losses(batch, matched)["l_lap"], full["l_lap"], rtol=1e-6, atol=1e-8)


def in_float32(pairs):
    return collate([
        {side: {k: v.float() if torch.is_tensor(v) and v.is_floating_point() else v for k, v in pair[side].items()}
         for side in ("first", "second")}
        for pair in pairs
    ])  # fmt: skip


@pytest.mark.parametrize("network", ["mlp", "diffusion"])
@pytest.mark.parametrize(("setup", "supervision", "truth_form"), [KINDS[2], KINDS[6], KINDS[8]])
def test_under_autocast_nothing_but_the_features_is_in_low_precision(setup, supervision, truth_form, network, pairs):
    net, batch = net_of(setup, supervision, truth_form, network=network).float(), in_float32(pairs)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        given = {side: net.features(batch[side]) for side in ("first", "second")}
        mixed, maps = net.losses(batch), net(batch["first"], batch["second"])
        errors = net.errors(batch, maps)
    assert {feat.dtype for feat in given.values()} == {torch.bfloat16}
    features = {id(batch[side]): given[side] for side in given}
    net.features.forward = lambda item: features[id(item)]  # the rest of the network, in float32, on these features
    with torch.no_grad():
        whole = net.losses(batch)
        wanted = net.errors(batch, net(batch["first"], batch["second"]))
    for name, value in whole.items():
        assert value.dtype == mixed[name].dtype == torch.float32
        assert torch.equal(mixed[name], value), name
    assert all(torch.equal(errors[name], value) for name, value in wanted.items())


@pytest.mark.parametrize(("setup", "supervision", "truth_form"), [KINDS[0], KINDS[5], KINDS[7]])
def test_mixed_losses_agree_within_the_rounding_of_linear_layers(setup, supervision, truth_form, pairs):
    """To first order a rounding of v by dv changes the loss by dL/dv dv, where |dv| <= unit |v|.

    A weight is rounded once for all vertices: the worst case, summed. Inputs and results of the layers are rounded at
    each vertex on their own: errors evenly spread on +-unit |v|, of which six standard deviations are allowed.
    """
    unit = 2.0**-9
    net, batch = net_of(setup, supervision, truth_form).float(), in_float32(pairs)
    inputs, rounded = net.features.inputs.forward, []
    net.features.inputs.forward = lambda item: inputs(item).requires_grad_()

    def keep(layer, given, result):
        for value in (*given, result):
            value.retain_grad()
            rounded.append(value)

    linear = [layer for layer in net.modules() if isinstance(layer, torch.nn.Linear)]
    handles = [layer.register_forward_hook(keep) for layer in linear]
    loss = sum(net.losses(batch).values())
    loss.backward()
    for handle in handles:
        handle.remove()
    weights = sum((p.grad * p).abs().sum().item() for p in net.parameters())
    values = sum((v.grad * v).square().sum().item() for v in rounded) ** 0.5
    bound = unit * (weights + 6 * values / 3**0.5)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        mixed = sum(net.losses(batch).values())
    assert 0 < (mixed - loss).abs() <= bound < 0.1 * loss


def test_without_a_network_the_features_are_the_inputs_and_the_rest_is_the_same(pairs):
    net, batch = net_of("quotient+odd", network="none"), collate(pairs)
    assert not list(net.parameters())
    inputs = InputFeatures(("wks",), 16, 20).double()
    values = inputs(batch["first"])
    torch.testing.assert_close(net.describe(batch["first"]), torch.nn.functional.normalize(values, dim=-1))
    errors = net.errors(batch, net(batch["first"], batch["second"]))
    assert errors["flipped_map"].sum() == 0
    assert errors["plain_error"].max() < 0.1
