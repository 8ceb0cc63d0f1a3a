import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchqm.matching import MatchParameters, MatchResult, SymmetryResult
from torchqm.matching.result import write_json, write_npz
from torchqm.spectral import SpectralBasis

MODES = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, -2.0], [1.0, -1.0, 1.0]], dtype=torch.float64)
MODES = MODES / MODES.norm(dim=0)
MAPS = torch.tensor([[3, 2, 1], [0, 1, 2]])


@pytest.fixture
def result():
    return MatchResult(
        maps=MAPS,
        labels=("direct", "mirrored"),
        scores=torch.tensor([0.1, 0.2], dtype=torch.float64),
        orbits=MAPS.T.contiguous(),
        fmaps=torch.arange(24.0, dtype=torch.float64).reshape(2, 4, 3),
        fmap_even=torch.eye(2, dtype=torch.float64),
        symmetry_source=torch.tensor([[0, 1, 2], [2, 1, 0]]),
        symmetry_target=torch.tensor([[0, 1, 2, 3], [3, 2, 1, 0]]),
        orientation=torch.tensor([0.9, -0.8], dtype=torch.float64),
        method="quotient",
        warnings=["careful"],
        parameters=MatchParameters().as_dict(),
        seconds={"all": 1.23456789},
        details={"residual_direct": 0.5},
    )


@pytest.fixture
def symmetry():
    return SymmetryResult(
        torch.tensor([[0, 1, 2], [2, 1, 0]]),
        ("direct", "mirrored"),
        torch.tensor([0.0, 0.3], dtype=torch.float64),
        SpectralBasis(torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64), MODES, torch.ones(3, dtype=torch.float64)),
        "extrinsic",
    )


def test_maps_by_label(result):
    assert torch.equal(result.direct, MAPS[0])
    assert torch.equal(result.mirrored, MAPS[1])
    unknown = replace(result, labels=("unknown", "unknown"))
    assert unknown.direct is None
    assert unknown.mirrored is None
    assert torch.equal(replace(result, labels=("unknown", "direct")).direct, MAPS[1])


def test_match_file(result, tmp_path):
    path = result.save(tmp_path / "maps.npz")
    assert path == tmp_path / "maps.npz"
    assert os.listdir(tmp_path) == ["maps.npz"]
    with np.load(path, allow_pickle=False) as file:
        found = {name: (file[name].shape, file[name].dtype.kind + str(file[name].dtype.itemsize)) for name in file}
        for name in set(file) - {"labels"}:
            assert np.array_equal(file[name], getattr(result, name).numpy()), name
        assert file["labels"].tolist() == ["direct", "mirrored"]
    assert found.pop("labels")[1].startswith("U")
    assert found == {
        "maps": ((2, 3), "i8"),
        "scores": ((2,), "f8"),
        "orbits": ((3, 2), "i8"),
        "fmaps": ((2, 4, 3), "f8"),
        "fmap_even": ((2, 2), "f8"),
        "symmetry_source": ((2, 3), "i8"),
        "symmetry_target": ((2, 4), "i8"),
        "orientation": ((2,), "f8"),
    }


def test_a_symmetry_has_its_functional_matrices_and_bases(symmetry):
    """Of a path of three vertices turned over, the mode in the middle is the odd one."""
    flip = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    assert torch.allclose(symmetry.fmaps, torch.stack([torch.eye(3, dtype=torch.float64), flip]), atol=1e-12)
    split = symmetry.symmetrized
    assert torch.allclose(split.even_evals, torch.tensor([0.0, 3.0], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(split.odd_evals, torch.tensor([1.0], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(split.even.evecs, split.even.evecs[[2, 1, 0]], atol=1e-12)
    assert torch.allclose(split.odd.evecs, -split.odd.evecs[[2, 1, 0]], atol=1e-12)
    assert symmetry.verdict is None  # that a pose has no plane does not make a shape asymmetric
    assert replace(symmetry, details={"verdict": "ambiguous"}).verdict == "ambiguous"
    alone = replace(symmetry, maps=symmetry.maps[:1], labels=("direct",), scores=symmetry.scores[:1])
    assert alone.symmetrized.odd.k == 0


def test_symmetry_file(symmetry, tmp_path):
    with np.load(symmetry.save(tmp_path / "symmetry.npz"), allow_pickle=False) as file:
        assert set(file) == {"maps", "labels", "scores", "fmaps"}
        assert np.array_equal(file["fmaps"], symmetry.fmaps.numpy())
        assert file["maps"].dtype == np.int64
        assert file["maps"].tolist() == symmetry.maps.tolist()
        assert file["labels"].tolist() == ["direct", "mirrored"]
        assert file["scores"].tolist() == [0.0, 0.3]


@pytest.mark.parametrize("old", [False, True])
def test_a_failing_write_leaves_no_part(result, tmp_path, monkeypatch, old):
    path = tmp_path / "maps.npz"
    if old:
        path.write_bytes(b"the old file")

    def half(file, **arrays):
        file.write(b"half a zip")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(OSError, match="disk full"):
        result.save(path)
    assert os.listdir(tmp_path) == (["maps.npz"] if old else [])
    assert not old or path.read_bytes() == b"the old file"


def test_json_is_whole_or_not_there(tmp_path):
    path = write_json(tmp_path / "summary.json", {"größe": [1.5], "none": None})
    assert json.loads(path.read_text(encoding="utf-8")) == {"größe": [1.5], "none": None}
    assert "größe" in path.read_text(encoding="utf-8")
    endless: dict = {}
    endless["self"] = endless
    with pytest.raises(ValueError, match="ircular"):
        write_json(tmp_path / "other.json", endless)
    assert os.listdir(tmp_path) == ["summary.json"]


def test_json_has_null_for_numbers_that_are_not_finite(tmp_path):
    content = {"a": float("nan"), "b": [float("inf"), {"c": (float("-inf"), 0.1)}], "d": np.float64("nan"), "e": "NaN"}
    text = write_json(tmp_path / "a.json", content).read_text()

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    expected = {"a": None, "b": [None, {"c": [None, 0.1]}], "d": None, "e": "NaN"}
    assert json.loads(text, parse_constant=refuse) == expected


@pytest.mark.parametrize("value", [torch.ones(2), np.arange(2), np.int64(1), {1}, b"x", Path("a.off"), object()])
def test_json_refuses_what_it_has_no_type_for(tmp_path, value):
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_json(tmp_path / "a.json", {"details": {"value": value}})
    assert os.listdir(tmp_path) == []


def test_written_files_replace_old_ones(tmp_path):
    for value in (1, 2):
        write_npz(tmp_path / "a.npz", a=np.array([value]))
    with np.load(tmp_path / "a.npz") as file:
        assert file["a"].tolist() == [2]


def test_summaries_are_plain_values(result, symmetry):
    """``json.dumps`` without help: nothing is a tensor or an array."""
    summary = result.summary()
    assert json.loads(json.dumps(summary)) == summary
    assert summary["maps"] == [
        {"label": "direct", "score": 0.1, "orientation": 0.9},
        {"label": "mirrored", "score": 0.2, "orientation": -0.8},
    ]
    assert summary["method"] == "quotient"
    assert summary["warnings"] == ["careful"]
    assert summary["parameters"]["k"] == 30
    assert summary["seconds"] == {"all": 1.2346}
    assert summary["details"] == {"residual_direct": 0.5}
    assert {"torchqm", "torch", "numpy", "scipy", "python"} <= set(summary["versions"])
    other = symmetry.summary()
    assert json.loads(json.dumps(other)) == other
    assert (other["origin"], other["order"], other["scores"]) == ("extrinsic", 2, [0.0, 0.3])
