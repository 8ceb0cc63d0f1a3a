"""torchqm.native: a library that is missing, or of another system, is none."""

import pytest
import torch

from torchqm import native
from torchqm.fmap import compiled


@pytest.mark.parametrize("file", [None, "text"], ids=["not built", "of another system"])
def test_where_it_is_missing_there_is_none(file, tmp_path, monkeypatch):
    spec = None
    if file:
        path = tmp_path / "_rows.so"
        path.write_text("not a library")
        spec = type("Spec", (), {"origin": str(path)})
    monkeypatch.setattr(native, "find_spec", lambda name: spec)
    native.library.cache_clear()
    compiled._load.cache_clear()
    try:
        assert native.library("torchqm.fmap._rows") is None
        assert compiled.kernel_for(torch.device("cpu"), torch.float32) is None
    finally:
        native.library.cache_clear()
        compiled._load.cache_clear()
