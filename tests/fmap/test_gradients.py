"""Every public function of torchqm.fmap that has a gradient: against finite differences, at all kinds of spectra."""

import pytest
import torch

import torchqm.fmap
from torchqm.fmap import (
    assignment_orbit_loss,
    bijectivity_energy,
    commutativity_energy,
    commutativity_mask,
    commutativity_weights,
    correspondence_fmap,
    deltas,
    descriptor_coefficients,
    descriptor_energy,
    distance_orbit_loss,
    frequency_mask,
    map_orbit_loss,
    nearest_isometry,
    orbit_consistency_fmap,
    orbit_consistency_points,
    orthogonality_energy,
    p2p_to_fmap,
    regularized_blocks,
    regularized_fmap,
    soft_assignment,
    soft_icp,
    soft_map,
    soft_upsample,
    solve_fmap,
    spectral_orbit_loss,
    surfmnet_losses,
)
from torchqm.spectral import SpectralBasis
from torchqm.testing import gradcheck64

K, V, C = 4, 7, 5
SPECTRA = {
    "separated": [0.3, 1.0, 2.1, 3.4],
    "clustered": [0.3, 1.0, 1.0 + 1e-7, 3.4],
    "repeated": [0.3, 1.0, 1.0, 3.4],
}
TRUTH, TABLE = torch.tensor([2, 0, 1, 6, 5, 4, 3]), torch.stack([torch.arange(V), torch.arange(V).flip(0)])


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def orthonormal(*shape, seed=0):
    return torch.linalg.qr(noise(*shape, seed=seed))[0]


def basis(evals, evecs, mass):
    return SpectralBasis(evals, evecs, mass)


def no_evals(function, *inputs):
    """A case whose gradient has nothing to do with eigenvalues."""
    return lambda x, y: (function, inputs)


def other(x):
    """The spectrum of the other shape: all but the highest eigenvalue the same."""
    return torch.cat([x[:3], x.new_tensor([5.0])])


FMAP, A, B = noise(K, K, seed=1), noise(K, C, seed=2), noise(K, C, seed=3)
EVECS, MASS, SOFT = noise(V, K, seed=4), noise(V, seed=5).abs() + 0.1, torch.softmax(noise(V, V, seed=6), 1)
SYMMETRIES, DIST = noise(2, K, K, seed=7), noise(V, V, seed=8).abs() + 0.1
CASES = {
    "assignment_orbit_loss": no_evals(lambda p: assignment_orbit_loss(p, TRUTH, TABLE), SOFT),
    "bijectivity_energy": no_evals(bijectivity_energy, FMAP[:3], FMAP[:, :3]),
    "commutativity_energy": lambda x, y: (commutativity_energy, (FMAP, x, y)),
    "commutativity_mask": lambda x, y: (commutativity_mask, (x, y)),
    "commutativity_weights": lambda x, y: (commutativity_weights, (x, y)),
    "correspondence_fmap": lambda x, y: (
        lambda a, b: correspondence_fmap(TRUTH, basis(x, a, MASS), basis(y, b, MASS), torch.arange(V)),
        (EVECS, noise(V, K, seed=9)),
    ),
    "deltas": lambda x, y: (lambda e, a: deltas(basis(e, a, MASS), 0.3), (x, EVECS)),
    "descriptor_coefficients": no_evals(descriptor_coefficients, noise(V, C), EVECS.T),
    "descriptor_energy": no_evals(descriptor_energy, FMAP, A, B),
    "distance_orbit_loss": no_evals(lambda p, d: distance_orbit_loss(p, TRUTH, TABLE, d), SOFT, DIST),
    "frequency_mask": lambda x, y: (frequency_mask, (x, y)),
    "map_orbit_loss": no_evals(lambda p, d: map_orbit_loss(p, TRUTH, TABLE, d, 0.3), SOFT, DIST),
    "nearest_isometry": no_evals(lambda m: tuple(nearest_isometry(part) for part in (m, m[:3], m[:, :2])), FMAP),
    "orbit_consistency_fmap": no_evals(orbit_consistency_fmap, FMAP, SYMMETRIES, SYMMETRIES.flip(0)),
    "orbit_consistency_points": no_evals(lambda p, f: orbit_consistency_points(p, TABLE, TABLE, f), SOFT, EVECS),
    "orthogonality_energy": no_evals(lambda m: (orthogonality_energy(m), orthogonality_energy(m[:3])), FMAP),
    "p2p_to_fmap": lambda x, y: (
        lambda a, b, m: p2p_to_fmap(TRUTH, basis(x, a, MASS), basis(y, b, m)),
        (EVECS, noise(V, K, seed=9), MASS),
    ),
    "regularized_blocks": lambda x, y: (
        lambda a, b, u, v: regularized_blocks([a, a[:2]], [b, b[:2]], [u, u[1:3]], [v, v[1:3]], 2.0),
        (A, B, x, y),
    ),
    "regularized_fmap": lambda x, y: (regularized_fmap, (A, B, x, y, torch.tensor(2.0))),
    "soft_assignment": no_evals(lambda s: soft_assignment(s, 0.5, 0), SOFT),
    "soft_icp": no_evals(lambda *given: soft_icp(*given, 2, 0.3), orthonormal(K, K), EVECS, noise(V, K, seed=9)),
    "soft_map": no_evals(
        lambda a, b, t: (soft_map(a, b, t), soft_map(a, b, t, 3).weights), EVECS, A.T, torch.tensor(2.0)
    ),
    "soft_upsample": no_evals(
        lambda *given: soft_upsample(*given, [3, 4], 1, 0.3, evals_mask_y=torch.arange(K) < 3),
        *(orthonormal(2, 2), EVECS, noise(V, K, seed=9)),
    ),
    "solve_fmap": lambda x, y: (solve_fmap, (A, B, x, y)),
    "spectral_orbit_loss": no_evals(lambda *given: spectral_orbit_loss(*given, TRUTH), FMAP, EVECS, EVECS),
    "surfmnet_losses": lambda x, y: (lambda *g: tuple(surfmnet_losses(*g).values()), (FMAP, FMAP.T, x, y)),
}
WITHOUT = {
    *("Places", "SurfaceSearch"),  # what others are given
    *("feature_neighbours", "fmap_to_p2p", "inner_pairings", "nearest_rows", "nearest_used", "orbit_members"),  # ids
    *("growing_pairs", "growing_sizes"),  # numbers
    # They alternate with nearest vertices, which have no gradient; soft_icp and soft_upsample are what has one.
    *("quotient_icp", "semi_quotient_icp", "semi_upsample", "two_way_upsample", "upsample"),
}


def test_every_function_is_here():
    assert set(CASES) | WITHOUT == set(torchqm.fmap.__all__)
    assert not set(CASES) & WITHOUT


@pytest.mark.parametrize("name", CASES)
def test_against_finite_differences(name):
    """The whole result, so that no entry can be wrong unseen, once for each kind of spectrum that has a say."""
    done = set()
    for spectrum in SPECTRA.values():
        x = torch.tensor(spectrum, dtype=torch.float64)
        function, inputs = CASES[name](x, other(x))
        if id(function) not in done:
            assert gradcheck64(function, *inputs)
        done.add(id(function))
