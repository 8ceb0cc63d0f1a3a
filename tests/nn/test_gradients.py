"""Every layer: gradients to all inputs and parameters, against finite differences, at all kinds of spectra."""

import pytest
import torch

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
from torchqm.testing import gradcheck64

K, V, C = 5, 6, 3
SPECTRA = {
    "separated": [20.0, 45.0, 70.0, 100.0, 150.0],
    "clustered": [20.0, 45.0, 45.0 + 1e-6, 100.0, 100.0 + 1e-6],
    "repeated": [20.0, 45.0, 45.0, 100.0, 100.0],
}
FLIP = torch.arange(V).flip(0)
TRUTH, TABLE = torch.tensor([[2, 0, 1, 5, 4, 3]]), torch.stack([torch.arange(V), FLIP])[None]
FACES = torch.tensor([[[0, 1, 2], [0, 2, 3], [1, 4, 5], [2, 5, 4]]])


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def orthonormal(*shape, seed=0):
    return torch.linalg.qr(noise(*shape, seed=seed))[0]


def symmetric_functions():
    """Orthonormal, three even and two odd under the flip: each kind has a cluster of its own in SPECTRA."""
    even, odd = noise(V // 2, 3, seed=1), noise(V // 2, 2, seed=2)
    even, odd = torch.linalg.qr(even)[0] / 2**0.5, torch.linalg.qr(odd)[0] / 2**0.5
    even, odd = torch.cat([even, even.flip(0)]), torch.cat([odd, -odd.flip(0)])
    return torch.cat([even, odd], 1)[None]


FEAT, OTHER, EVECS, MASS = (
    noise(1, V, C),
    noise(1, V, C, seed=3),
    noise(1, V, K, seed=4),
    noise(1, V, seed=5).abs() + 0.1,
)
SOFT, FMAP, VERTS = torch.softmax(noise(1, V, V, seed=6), -1), noise(1, K, K, seed=7), noise(1, V, 3, seed=8)
TRANS = (EVECS * MASS[..., None]).mT


def split_of(evals, evecs, fmaps):
    """What does not depend on the choice of vectors in a cluster: projectors onto whole ones, sums over each half."""
    layer = SymmetrizedBasis()
    split = layer(evals, evecs, torch.ones(1, V).double(), fmaps=fmaps)
    weight = noise(V, V, seed=9)
    clusters = (split.evecs_even[..., :1], split.evecs_even[..., 1:], split.evecs_odd)
    parts = [((vectors @ vectors.mT) * weight).sum() for vectors in clusters]
    traces = [(values / 100).square().sum() for values in (split.evals_even, split.evals_odd)]
    return (
        *parts,
        *traces,
        split.spectrum.square().sum(),
        layer.projector(evecs, torch.ones(1, V).double(), fmaps=fmaps),
    )


def features(evals, evecs, mass, verts):
    layer = InputFeatures(("xyz", "normals", "wks", "hks"), 2, 6).double()
    return layer({"verts": verts, "faces": FACES, "mass": mass, "evals": evals, "evecs": evecs})


def with_parameters(layer, count):
    """A function of ``count`` inputs and the layer's parameters, and these."""
    layer = layer.double()
    names, values = zip(*layer.named_parameters(), strict=True)

    def call(*given):
        named = dict(zip(names, given[count:], strict=True))
        return torch.func.functional_call(layer, named, given[:count])

    return call, values


def network(evals):
    torch.manual_seed(0)
    call, values = with_parameters(
        DiffusionNet(C, 2, 2, 1, with_gradient_features=False, last_activation=torch.tanh, dropout=False), 5
    )
    return lambda x, m, e, phi, *ps: call(x, m, None, e, phi, *ps), (FEAT, MASS, evals, EVECS, *values)


def signature(layer, evals):
    call, values = with_parameters(layer, 3)
    return call, (evals, EVECS, MASS, *values)


def solver(evals):
    """Both directions, an odd block, and a learned weight."""
    layer = FunctionalMapSolver(3.0, bidirectional=True, learn_lmbda=True, ridge=0.1).double()

    def call(feat_x, feat_y, x, y, trans_x, trans_y, log_lmbda):
        odd = {"evals_odd_x": x[:, 1:4], "evals_odd_y": y[:, 1:4]}
        odd |= {"evecs_trans_odd_x": trans_x[:, 1:4], "evecs_trans_odd_y": trans_y[:, 1:4]}
        given = (feat_x, feat_y, x, y, trans_x, trans_y)
        maps = torch.func.functional_call(layer, {"log_lmbda": log_lmbda}, given, odd)
        return *maps[0], *maps[1]

    # The largest eigenvalue of the pair is the unit, and a maximum has no derivative where two are the largest.
    evals_y = torch.cat([evals[:, :-1], evals[:, -1:] + 60], 1)
    return call, (FEAT, OTHER, evals, evals_y, TRANS, TRANS.flip(1), layer.log_lmbda)


def mlp():
    torch.manual_seed(0)
    call, values = with_parameters(MLP(C, 2, (3,), layer_norm=True), 1)
    return call, (FEAT, *values)


def soft_point_map():
    call, values = with_parameters(SoftPointMap(0.5, learn_tau=True, kind="distance"), 2)
    return call, (FEAT, OTHER, *values)


def refinement(layer, size):
    call, values = with_parameters(layer, 4)
    return call, (orthonormal(1, size, size), EVECS[..., :4], noise(1, V, 4, seed=9), MASS, *values)


def consistency(fmap, first, second, soft, values):
    points = OrbitConsistencyLoss("points")(soft, TABLE, TABLE, values_y=values)
    return OrbitConsistencyLoss()(fmap, first, second), points


def orbit(fmap, evecs_x, evecs_y, soft, dist):
    spectral = {"fmap_even": fmap, "evecs_even_x": evecs_x, "evecs_even_y": evecs_y}
    group = {"soft_xy": soft, "group_y": TABLE}
    return (
        PointToOrbitLoss("spectral")(TRUTH, MASS, **spectral),
        PointToOrbitLoss("assignment")(TRUTH, MASS, **group),
        PointToOrbitLoss("distance")(TRUTH, MASS, **group, dist_y=dist),
        PointToOrbitLoss("map", temperature=0.3)(TRUTH, MASS, **group, dist_y=dist),
    )


SYMMETRIES = noise(1, 2, K, K, seed=10)


def reflection():
    """Exact, and mixes the first even with the first odd function, so that moving it turns vectors inside a half."""
    turn = torch.eye(K).double()
    turn[[0, 0, 3, 3], [0, 3, 0, 3]] = torch.tensor([0.96, -0.28, 0.28, 0.96]).double()
    return (turn @ torch.diag(torch.tensor([1.0, 1, 1, -1, -1])).double() @ turn.T)[None]


CASES = {  # of eigenvalues: the function and its inputs
    "SymmetrizedBasis": lambda e: (split_of, (e, symmetric_functions(), reflection())),
    "WaveKernelSignature": lambda e: signature(WaveKernelSignature(3, 6), e),
    "HeatKernelSignature": lambda e: signature(HeatKernelSignature(3, 6), e),
    "InputFeatures": lambda e: (features, (e, EVECS, MASS, VERTS)),
    "DiffusionNet": network,
    "FunctionalMapSolver": solver,
    "FunctionalMapLoss": lambda e: (
        lambda *given: tuple(FunctionalMapLoss(w_lap=1e-3)(*given).values()),
        (FMAP, FMAP.mT, e, e.clone()),
    ),
}
WITHOUT_EVALS = {
    "MLP": mlp,
    "OrbitConsistencyLoss": lambda: (consistency, (FMAP, SYMMETRIES, SYMMETRIES.flip(1), SOFT, OTHER)),
    "OrientationDescriptors": lambda: (lambda f, m: OrientationDescriptors(C)(f, FACES, m), (FEAT, MASS)),
    "PointToOrbitLoss": lambda: (orbit, (FMAP, EVECS, EVECS.flip(1), SOFT, noise(1, V, V).abs() + 0.1)),
    "QuotientICP": lambda: refinement(QuotientICP(2, 0.3, learn_tau=True), 4),
    "Similarity": lambda: (Similarity(1, 0.5), (SOFT,)),
    "SoftPointMap": soft_point_map,
    "SpectralUpsampling": lambda: refinement(SpectralUpsampling((3, 4), 1, 0.3, learn_tau=True), 2),
}


def test_every_layer_is_here():
    assert set(CASES) | set(WITHOUT_EVALS) == set(torchqm.nn.__all__)


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("name", CASES)
def test_at_all_spectra(name, spectrum):
    function, inputs = CASES[name](torch.tensor([SPECTRA[spectrum]], dtype=torch.float64))
    assert gradcheck64(function, *inputs)


@pytest.mark.parametrize("name", WITHOUT_EVALS)
def test_where_no_eigenvalues_enter(name):
    function, inputs = WITHOUT_EVALS[name]()
    assert gradcheck64(function, *inputs)
