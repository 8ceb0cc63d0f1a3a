"""torchqm.matching.baselines.pyfm: the direction of its maps, its accuracy, and what is said where it is missing."""

import sys

import pytest
import torch
from references.pairs import exact_pair

from torchqm.matching import MatchError
from torchqm.matching.baselines import PyFM, ZoomOut


def test_the_map_runs_from_x_to_y():
    pytest.importorskip("pyFM")
    pair = exact_pair(1)
    for icp in (False, True):
        found = PyFM(k=20, k_max=60, step=10, n_descriptors=20, icp=icp, n_samples=None).match(pair.x, pair.y)
        assert float((found.best == pair.p2p_xy).double().mean()) > 0.99
        assert ("pyFM: ICP" in found.steps) == icp
    assert found.details["k"] == 60
    assert "pyfmaps 1" in found.notes[0]


def test_as_accurate_as_our_own_zoomout(walkers):
    """Nearest descriptors are above 0.07; the two implementations of ZoomOut end within each other's noise."""
    pytest.importorskip("pyFM")
    theirs = PyFM(k=30, n_samples=300).match(walkers.x, walkers.y)
    error = float(walkers.errors(theirs.best)[0])
    assert error < 0.02
    assert abs(error - float(walkers.errors(ZoomOut().match(walkers.x, walkers.y).best)[0])) < 0.01
    again = PyFM(k=30, n_samples=300).match(walkers.x, walkers.y)
    assert torch.equal(again.best, theirs.best)  # pyFM itself starts its samples from a random vertex


def test_too_few_eigenfunctions(walkers):
    pytest.importorskip("pyFM")
    with pytest.raises(MatchError, match="map of 120 functions from 80 eigenfunctions"):
        PyFM(k=120).match(walkers.x, walkers.y)


def test_a_clear_error_where_it_is_not_installed(walkers, monkeypatch):
    for name in [n for n in sys.modules if n == "pyFM" or n.startswith("pyFM.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pyFM", None)
    with pytest.raises(ImportError, match=r"pyfm: needs the package pyfmaps \(pip install"):
        PyFM().match(walkers.x, walkers.y)
