import importlib
import pkgutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import torchqm

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("name", torchqm.__all__)
def test_public_names_resolve_and_are_listed(name):
    assert getattr(torchqm, name) is not None
    assert name in dir(torchqm)


def test_every_lazy_name_is_public_and_the_other_way_round():
    assert set(torchqm._HOME_OF) == set(torchqm.__all__) - {"__version__"}


@pytest.mark.parametrize("name", torchqm._SUBPACKAGES)
def test_subpackages_are_loaded_on_first_use_and_name_what_they_have(name):
    module = getattr(torchqm, name)
    assert module.__name__ == f"torchqm.{name}"
    assert [n for n in module.__all__ if not hasattr(module, n)] == []
    assert sorted(module.__all__) == sorted(set(module.__all__))


PACKAGES = {found.name for found in pkgutil.walk_packages(torchqm.__path__, "torchqm.") if found.ispkg}


@pytest.mark.parametrize("name", sorted(PACKAGES - {f"torchqm.{name}" for name in torchqm._SUBPACKAGES}))
def test_other_packages_have_what_they_name(name):
    module = importlib.import_module(name)
    assert [n for n in getattr(module, "__all__", []) if not hasattr(module, n)] == []


def test_the_name_of_a_class_means_one_thing():
    """The same name in two subpackages is the same class: a result must not be taken for the layer that makes it."""
    meanings = {}
    for package in sorted(PACKAGES | {"torchqm"}):
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", []):
            if isinstance(getattr(module, name), type):
                meanings.setdefault(name, {})[id(getattr(module, name))] = package
    assert {name: sorted(found.values()) for name, found in meanings.items() if len(found) > 1} == {}


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = torchqm.nonsense


def test_constraints_name_a_version_of_every_dependency():
    """A fresh installation gets the versions that the tests passed with."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {
        line.split(">=")[0].split("==")[0].split("[")[0].strip().lower().replace("_", "-")
        for line in [*project["dependencies"], *project["optional-dependencies"]["test"]]
    }
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in lines}
    assert all(line.count("==") == 1 for line in lines)
    assert wanted - pinned == set()


def test_version_is_read_without_torch():
    script = "import sys, torchqm; print(torchqm.__version__, 'torch' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.split() == [torchqm.__version__, "False"]
