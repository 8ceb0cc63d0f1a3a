"""Options of all layers: each is checked when the layer is made, and named with what was given and what is allowed."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from references.unchecked import unchecked

import torchqm.nn
from torchqm.nn import (
    MLP,
    DiffusionNet,
    FunctionalMapLoss,
    FunctionalMapSolver,
    HeatKernelSignature,
    InputFeatures,
    OrbitConsistencyLoss,
    OrientationDescriptors,
    PointToOrbitLoss,
    QuotientICP,
    Similarity,
    SoftPointMap,
    SpectralUpsampling,
    SymmetrizedBasis,
    WaveKernelSignature,
)
from torchqm.spectral import WaveEnergies

NAN, INF = float("nan"), float("inf")
POSITIVE = (0, -1.0, NAN, INF)
NOT_NEGATIVE = (-0.1, NAN, INF)
NETWORK, SIZES = {"C_in": 4, "C_out": 3, "C_width": 4, "N_block": 1}, {"sizes": (4,)}
VALUES = [  # layer, options it needs, option, wrong values
    (SymmetrizedBasis, {}, "k_even", (-1,)),
    (SymmetrizedBasis, {}, "k_odd", (-1,)),
    (SymmetrizedBasis, {}, "rtol", NOT_NEGATIVE),
    (WaveKernelSignature, {}, "n", (1, 0)),
    (WaveKernelSignature, {}, "k", (2,)),
    (HeatKernelSignature, {}, "n", (0,)),
    (HeatKernelSignature, {}, "k", (2,)),
    (HeatKernelSignature, {}, "times", (torch.tensor([-1.0]), torch.tensor([NAN]), torch.ones(2, 2), torch.ones(0))),
    (OrientationDescriptors, {}, "n_features", (1,)),
    (OrientationDescriptors, {"n_features": 3}, "n_pairs", (0, 4)),
    *[(DiffusionNet, NETWORK, name, (0, -1)) for name in NETWORK],
    (DiffusionNet, NETWORK, "outputs_at", ("faces", None)),
    (DiffusionNet, NETWORK, "dropout", (1, 1.0, -0.1, NAN)),
    (DiffusionNet, NETWORK, "diffusion_method", ("implicit_dense",)),
    (InputFeatures, {}, "names", ((), ("shot",), ("wks", "wks"))),
    (InputFeatures, {}, "n", (1,)),
    (MLP, {"c_out": 3}, "c_in", (0,)),
    (MLP, {"c_in": 3}, "c_out", (0,)),
    (MLP, {"c_in": 3, "c_out": 3}, "dropout", (1, -0.1, NAN)),
    (PointToOrbitLoss, {}, "form", ("nearest", None)),
    (PointToOrbitLoss, {}, "reduction", ("sum",)),
    (PointToOrbitLoss, {}, "eps", (0.0, 1.0, NAN)),
    (PointToOrbitLoss, {"form": "map"}, "temperature", (-1.0, NAN, INF, 1e-31)),
    *[(FunctionalMapLoss, {}, name, NOT_NEGATIVE) for name in ("w_bij", "w_orth", "w_lap")],
    (OrbitConsistencyLoss, {}, "form", ("dense",)),
    (OrbitConsistencyLoss, {}, "reduction", ("sum",)),
    (OrbitConsistencyLoss, {}, "temperature", (-1.0, NAN, INF, 1e-31)),
    (QuotientICP, {}, "steps", (-1,)),
    (QuotientICP, {}, "tau", POSITIVE),
    (QuotientICP, {}, "neighbours", (0,)),
    (SpectralUpsampling, SIZES, "steps", (0,)),
    (SpectralUpsampling, SIZES, "tau", POSITIVE),
    (SpectralUpsampling, SIZES, "neighbours", (-2,)),
    (Similarity, {}, "tau", POSITIVE),
    (SoftPointMap, {}, "tau", POSITIVE),
    (SoftPointMap, {}, "k", (0,)),
    (SoftPointMap, {}, "kind", ("cosine",)),
    (SoftPointMap, {"k": 2}, "chunk", (0,)),
    (FunctionalMapSolver, {}, "lmbda", NOT_NEGATIVE),
    (FunctionalMapSolver, {"learn_lmbda": True}, "lmbda", POSITIVE),
    (FunctionalMapSolver, {}, "resolvant_gamma", POSITIVE),
    (FunctionalMapSolver, {}, "commutativity", ("cubed",)),
    (FunctionalMapSolver, {}, "extra_weight", NOT_NEGATIVE),
    (FunctionalMapSolver, {}, "ridge", NOT_NEGATIVE),
    (FunctionalMapSolver, {}, "row_chunk", (0,)),
]
TYPES = [  # layer, options it needs, option, a value that a user easily gives
    (SymmetrizedBasis, {}, "k_even", 4.0),
    (SymmetrizedBasis, {}, "rtol", "1e-3"),
    (WaveKernelSignature, {}, "n", 16.0),
    (WaveKernelSignature, {}, "learnable", "no"),
    (HeatKernelSignature, {}, "times", [0.1, 1.0]),
    (OrientationDescriptors, {"n_features": 3}, "n_pairs", 1.5),
    (OrientationDescriptors, {"n_features": 3}, "seed", torch.Generator()),
    (DiffusionNet, NETWORK, "C_in", "16"),
    (DiffusionNet, NETWORK, "last_activation", "softmax"),
    (DiffusionNet, NETWORK, "mlp_hidden_dims", 64),
    (DiffusionNet, NETWORK, "dropout", None),
    (DiffusionNet, NETWORK, "with_gradient_features", None),
    (InputFeatures, {}, "n", 8.0),
    (MLP, {"c_in": 3, "c_out": 3}, "hidden", 128),
    (MLP, {"c_in": 3, "c_out": 3}, "layer_norm", 0.5),
    (PointToOrbitLoss, {"form": "map"}, "temperature", None),
    (PointToOrbitLoss, {}, "log_weights", 1),
    (FunctionalMapLoss, {}, "w_bij", None),
    (OrbitConsistencyLoss, {}, "temperature", torch.tensor(0.1)),
    (QuotientICP, {}, "tau", torch.tensor(0.1)),
    (QuotientICP, {}, "steps", 2.0),
    (QuotientICP, {}, "learn_tau", 10),
    (SpectralUpsampling, {}, "sizes", 40),
    (SpectralUpsampling, SIZES, "neighbours", 5.0),
    (Similarity, {}, "normalise_dim", None),
    (Similarity, {}, "hard", "soft"),
    (SoftPointMap, {}, "learn_tau", 10),  # SoftPointMap(0.2, 10), meant as k
    (SoftPointMap, {}, "k", True),
    (SoftPointMap, {}, "normalize", -1),
    (FunctionalMapSolver, {}, "lmbda", torch.tensor(100.0)),
    (FunctionalMapSolver, {}, "bidirectional", "both"),
    (FunctionalMapSolver, {}, "row_chunk", 1e3),
]


def make(layer, **options):
    """The layer without the suite's own check of annotations."""
    made = layer.__new__(layer)
    unchecked(layer.__init__)(made, **options)
    return made


def name_of(case):
    return f"{case[0].__name__}-{case[2]}"


def test_every_layer_is_here():
    assert {case[0] for case in VALUES} == {getattr(torchqm.nn, name) for name in torchqm.nn.__all__}


@pytest.mark.parametrize(("layer", "needed", "option", "values"), VALUES, ids=map(name_of, VALUES))
def test_a_wrong_value_is_named(layer, needed, option, values):
    for value in values:
        with pytest.raises(ValueError, match=rf"^{option}(: .* given|: \d of \d entries).*(expected|allowed|make)"):
            make(layer, **{**needed, option: value})


def faults():
    """What is raised for a value of another type, in the order of TYPES."""
    for layer, needed, option, value in TYPES:
        try:
            layer(**{**needed, option: value})
        except TypeError as error:
            yield str(error)
        else:
            yield "nothing"


def numbers():
    """Whole numbers for real ones, zero where it has a meaning, numbers of numpy."""
    yield Similarity(tau=1).tau == 1
    yield SpectralUpsampling(np.array([3, 5])).sizes == (3, 5)
    yield PointToOrbitLoss("map", temperature=0).options == {"temperature": 0}
    yield QuotientICP(0, np.float32(0.5)).steps == 0
    yield SymmetrizedBasis(k_odd=0, rtol=0).k_odd == 0
    yield FunctionalMapSolver(0, ridge=1).lmbda == 0
    yield HeatKernelSignature(times=torch.tensor([0, 1])).log_times.dtype == torch.float32


UNCHECKED = """
import importlib.util, json, sys
sys.path.insert(0, sys.argv[1])
spec = importlib.util.spec_from_file_location("options", sys.argv[2])
options = importlib.util.module_from_spec(spec)
spec.loader.exec_module(options)
print(json.dumps([list(options.faults()), list(options.numbers())]))
"""


@pytest.fixture(scope="module")
def without_type_checks():
    """The two lists, from a process in which nothing but the layers checks types."""
    tests, package = Path(__file__).resolve().parents[1], Path(torchqm.__file__).parents[1]
    command = [sys.executable, "-W", "ignore", "-c", UNCHECKED, str(tests), __file__]
    environment = os.environ | {"PYTHONPATH": str(package)}
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout)


@pytest.mark.parametrize("case", range(len(TYPES)), ids=map(name_of, TYPES))
def test_a_wrong_type_is_named(without_type_checks, case):
    assert re.match(rf"{TYPES[case][2]}: (.* given, )?expected ", without_type_checks[0][case])


def test_what_numbers_may_be(without_type_checks):
    assert without_type_checks[1] == [True] * 7


def test_the_energies_of_a_signature():
    for energies, message in (
        (WaveEnergies(torch.zeros(3), 0.0), "energies.sigma: 0.0 given, expected a positive number"),
        (WaveEnergies(torch.full((3,), NAN), 1.0), "energies.log_energies: 3 of 3 entries are NaN"),
        (WaveEnergies(torch.zeros(0), 1.0), "energies.log_energies: no number given"),
    ):
        with pytest.raises(ValueError, match=message):
            WaveKernelSignature(energies=energies)
