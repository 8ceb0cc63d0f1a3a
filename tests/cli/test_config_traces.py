from typing import Optional

import pytest
from jsonargparse import ArgumentParser

from torchqm.cli.config_traces import causes, group_made, modules, objects_made


class Part:
    """An object that cannot be made."""

    def __init__(self, size: int = 1):
        raise KeyError(size)


def error_of(add):
    parser = ArgumentParser(exit_on_error=False)
    add(parser)
    with pytest.raises((ValueError, KeyError)) as caught:
        parser.instantiate(parser.parse_args([]))
    return caught.value


def test_the_error_of_an_object_is_found_behind_what_jsonargparse_says():
    value = {"class_path": f"{__name__}.Part", "init_args": {"size": 3}}
    error = error_of(lambda parser: parser.add_argument("--part", type=Optional[Part], default=value))  # noqa: UP045
    assert isinstance(error, ValueError)
    assert isinstance(causes(error)[-1], KeyError)
    assert objects_made(error)[-1] == (Part, {"size": 3})
    assert modules(error)[-1] == __name__
    assert group_made(error) == ""


def test_an_object_of_a_group_has_its_name():
    error = error_of(lambda parser: parser.add_class_arguments(Part, "part"))
    assert causes(error) == [error]
    assert (group_made(error), objects_made(error)[-1][0]) == ("part", Part)


def test_an_error_of_its_own_is_its_own_cause():
    inner = KeyError("x")
    with pytest.raises(ValueError, match="y") as caught:
        raise ValueError("y") from inner
    assert causes(caught.value) == [caught.value]  # whoever raised it knew why
    assert causes(inner) == [inner]  # never raised
    assert modules(inner) == []
