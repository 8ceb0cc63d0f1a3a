"""Every layer, given no shape, one function, one vertex, empty masks, NaN or another dtype: right, or a clear error."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from references import degenerate
from references.degenerate import CALLS, CHANGES, given

import torchqm

SCRIPT = Path(degenerate.__file__)
LAYERS = list(CALLS)
LOSSES = [layer for layer in LAYERS if "Loss" in layer]
NAMES = {  # what a layer may call what was changed
    "vmask": "verts_mask|mask_x|mask_y|truth_mask|p2p_xy",
    "kmask": "evals_mask|evals_odd_mask",
    "gmask": "group_mask",
    "feat": "feat|x_in|log_alpha|coeffs|values_y",
    "evals": "evals",
    "evecs": "evecs",
    "evecs_trans": "evecs_trans",
    "mass": "mass|p2p_xy: no point of shape 0 has both a truth and a positive area",
    "fmap": "fmap|map_xy|C12",
    "soft": "soft|map_xy",
    "dist": "dist_y",
    "verts": "verts",
    "truth": "p2p_xy",
    "group": "group|symmetry_x",
    "faces": "faces",
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """What every layer returned or raised in every case, in one process without the suite's type checks."""
    path = tmp_path_factory.mktemp("degenerate") / "outcomes.pt"
    environment = os.environ | {"PYTHONPATH": str(Path(torchqm.__file__).parents[1])}
    subprocess.run([sys.executable, str(SCRIPT), str(path)], check=True, env=environment)
    return torch.load(path)


def result(outcome):
    assert isinstance(outcome, list), outcome
    assert all(bool(torch.isfinite(tensor.double()).all()) for tensor in outcome)
    return outcome


def refused(outcome, names):
    assert isinstance(outcome, tuple), "not refused"
    is_value_error, whole, message = outcome
    assert is_value_error, whole
    assert any(message.startswith(name) for name in names.split("|")), whole


def same(outcome, usual, **tolerance):
    for ours, wanted in zip(result(outcome), usual, strict=True):
        torch.testing.assert_close(ours, wanted, check_dtype=False, **tolerance)


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("case", CHANGES)
def test_what_is_wrong_is_named(outcomes, case, layer):
    """An error that names it; a layer that does not read it gives what it gives otherwise."""
    changed, usual = set(CHANGES[case][0]) & set(CALLS[layer][0]), result(outcomes["as usual", layer])
    outcome = outcomes[case, layer]
    if not changed:
        return same(outcome, usual)
    if case == "no area" and layer in ("OrientationDescriptors", "DiffusionNet", "DiffusionNet.mean"):
        result(outcome)  # vertices without area count nothing
        return None
    if case == "mask of functions all false" and layer == "FunctionalMapSolver.odd":
        odd = result(outcome)[1]  # of a shape without symmetry
        return same([odd], [torch.zeros_like(odd)])
    if case == "basis in float64" and isinstance(outcome, list):  # all that it reads, or it follows the basis
        assert "feat" not in CALLS[layer][0]
        return same(outcome, usual, atol=1e-5, rtol=1e-5)
    names = changed | (set(CALLS[layer][0]) if case == "basis in float64" else set())  # either side of what differs
    return refused(outcome, "|".join(NAMES[name] for name in names))


@pytest.mark.parametrize("layer", LAYERS)
def test_no_shape(outcomes, layer):
    """Of no shape there are no results, and no mean."""
    outcome = outcomes["no shape", layer]
    if layer in LOSSES:
        return refused(outcome, "p2p_xy: an empty batch|map_xy: an empty batch|C12: an empty batch")
    usual = result(outcomes["as usual", layer])
    found = result(outcome)
    assert len(found) == len(usual)
    for ours, wanted in zip(found, usual, strict=True):
        assert ours.shape[0] == 0
        assert ours.ndim == wanted.ndim
        if layer.split(".")[0] != "SymmetrizedBasis" or layer.endswith(
            ("projector", "parts")
        ):  # widths are of the data
            assert ours.shape[1:] == wanted.shape[1:]
    return None


def exact(layer, d):
    """Where all there is is the constant function, or one vertex: a shape and itself, under the identity."""
    one, nothing = torch.ones(2, 1, 1), torch.zeros(())
    if layer.startswith("SymmetrizedBasis"):
        if layer.endswith("projector"):
            return [one]
        if layer.endswith("parts"):
            return [d["feat"][:, :1], torch.zeros_like(d["feat"][:, :1])]
        v = d["mass"].shape[1]
        odd = [torch.zeros(2, 0), torch.zeros(2, v, 0), torch.zeros(2, 1, 0), torch.zeros(2, 0)]
        true = torch.ones(2, 1, dtype=torch.bool)
        return [d["evals"], torch.ones(2, v, 1), one, true, *odd, torch.ones(2, 1), d["mass"]]
    if layer in ("QuotientICP", "SpectralUpsampling"):
        return [one]
    if layer.startswith("FunctionalMapSolver"):
        return [one / 1.1 if layer.endswith("odd") else one] * 2  # the ridge is a tenth of the descriptors' energy
    if layer == "FunctionalMapLoss":
        return [nothing] * 3
    return [nothing] if layer in ("PointToOrbitLoss.spectral", "OrbitConsistencyLoss") else None


@pytest.mark.parametrize("layer", LAYERS)
def test_one_function(outcomes, layer):
    outcome, d = outcomes["one function", layer], given(k=1)
    if layer in ("WaveKernelSignature", "HeatKernelSignature", "InputFeatures"):
        return refused(outcome, "evecs: 1 functions given; a signature needs at least 3")
    expected = exact(layer, d)
    if expected is None and not {"evals", "evecs"} & set(CALLS[layer][0]):
        expected = outcomes["as usual", layer]
    if expected is None:  # a network
        result(outcome)
        return None
    return same(outcome, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("layer", LAYERS)
def test_one_vertex(outcomes, layer):
    outcome, d = outcomes["one vertex", layer], given(v=1, k=1)
    if layer in ("WaveKernelSignature", "HeatKernelSignature", "InputFeatures"):
        return refused(outcome, "evecs: 1 functions given; a signature needs at least 3")
    expected = exact(layer, d)
    if layer in LOSSES and expected is None:
        expected = [torch.zeros(())]  # nowhere else to go
    elif layer == "OrientationDescriptors":
        expected = [torch.zeros(2, 1, 15)]  # its triangle is a point
    elif layer == "SoftPointMap":
        expected = [torch.ones(2, 1, 1)]
    elif layer == "SoftPointMap.k":
        expected = [torch.zeros(2, 1, 1), torch.ones(2, 1, 1)]
    if expected is None:
        result(outcome)
        return None
    return same(outcome, expected, atol=1e-6, rtol=0)
