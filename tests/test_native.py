"""torchqm.native: a library that is missing, or of another system, is none; what there is, is said."""

import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES

import pytest

from torchqm import native
from torchqm.fmap import compiled


@pytest.fixture
def empty(tmp_path, monkeypatch):
    """As if nothing had been built."""
    monkeypatch.setattr(native, "_PACKAGE", tmp_path)
    native.library.cache_clear()
    yield tmp_path
    native.library.cache_clear()


@pytest.mark.parametrize("file", [False, True], ids=["not built", "of another system"])
def test_where_it_is_missing_there_is_none(file, empty):
    if file:
        (empty / "fmap").mkdir()
        (empty / f"fmap/_rows{EXTENSION_SUFFIXES[0]}").write_text("not a library")
    assert native.available() == []
    assert native.library("fmap/_rows") is None
    assert compiled._kernels() == {}


@pytest.mark.skipif(not native.available(), reason="nothing is built here")
def test_what_was_built_of_other_files_is_left_alone(monkeypatch):
    monkeypatch.setattr(native, "_ABI", native._ABI + 1)
    assert native.available() == []


def test_the_version_says_what_is_there_without_loading_torch():
    code = (
        "import sys; from torchqm.cli.main import main\n"
        "try: main(['--version'])\n"
        "finally: assert 'torch' not in sys.modules, 'torch was loaded'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    words = ", ".join(native.available()) or "none; functional maps and eigenpairs take longer"
    assert done.stdout.splitlines()[1] == f"compiled parts: {words}"
