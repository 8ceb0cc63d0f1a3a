from dataclasses import fields
from inspect import signature

import pytest

from torchqm.learn import MatchModule, NetOptions


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"setup": "quotients"}, "setup: 'quotients' given, allowed are functional_map, quotient, quotient\\+odd"),
        ({"supervision": "full"}, "supervision: 'full' given"),
        ({"truth_form": "distance"}, "truth_form: 'distance' given"),
        ({"network": "gnn"}, "network: 'gnn' given, allowed are mlp, diffusion, none"),
        ({"k": 0}, "k: 0 given"),
        ({"channels": 1}, "channels: 1 given"),
        ({"tau": 0.0}, "tau: 0.0 given"),
        ({"w_align": -1.0}, "w_align: -1.0 given"),
        ({"setup": "quotient", "supervision": "plain"}, "'plain' given for setup 'quotient'"),
        (
            {"setup": "functional_map", "supervision": "orbit"},
            "setup 'functional_map' has none: use truth_form 'assign",
        ),
        ({"inputs": ["wkss"]}, "inputs: 'wkss' given, allowed are xyz, normals, wks, hks; the nearest is wks"),
        ({"inputs": ["wks", "wks"]}, "inputs: .* each at most once"),
        ({"w_bij": 0, "w_orth": 0, "w_lap": 0, "w_align": 0}, "leaves no loss"),
    ],
)
def test_options_that_make_no_sense_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        NetOptions(**options)


def test_the_module_has_every_option_with_the_same_default():
    given = {name: parameter.default for name, parameter in signature(MatchModule.__init__).parameters.items()}
    assert {field.name: field.default for field in fields(NetOptions)}.items() <= given.items()


def test_gradients_are_asked_for_where_they_are_used():
    assert "gradients" in NetOptions(network="diffusion").keys
    assert "gradients" not in NetOptions(network="diffusion", gradients=False).keys
    assert "gradients" not in NetOptions(network="mlp").keys
