"""torchqm.matching.baselines.registry: every name has a matcher that keeps to the protocol and can travel."""

import pickle
import re

import pytest

from torchqm.matching.baselines import DESCRIPTIONS, MATCHERS, Matcher, get_matcher


def test_names():
    wanted = "quotient quotient-true-axis paper semi fmap zoomout zoomout-fast orient-rev descriptors axis-curves"
    assert set(wanted.split()) | {"symmetry-factored", "pyfm", "quotient-estimated-axis"} == set(MATCHERS)
    assert set(DESCRIPTIONS) == set(MATCHERS)
    for name, matcher in MATCHERS.items():
        assert re.fullmatch(r"[a-z]+(-[a-z]+)*", name)
        assert isinstance(matcher, Matcher)
        assert matcher.name == name
        assert set(matcher.needs) <= {"symmetry", "reference", "self"}
        assert get_matcher(name) is matcher
        assert pickle.loads(pickle.dumps(matcher)) == matcher


def test_an_unknown_name_lists_the_others():
    with pytest.raises(ValueError, match=r"method 'bim': unknown; allowed are quotient, .*pyfm"):
        get_matcher("bim")


def test_what_a_matcher_needs_is_what_it_refuses_to_do_without(walkers):
    for name, matcher in MATCHERS.items():
        if matcher.needs:
            with pytest.raises(ValueError, match=name):
                matcher.match(walkers.x, walkers.y)
