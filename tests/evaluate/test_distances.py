"""Distances in chunks: exact on flat shapes, resumed where they were stopped, under the name of the solver that ran."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import shapes

import torchqm.geometry.geodesic
from torchqm.evaluate import TruthDistances
from torchqm.evaluate.distances import distance_rows, pair_distances, solver_used
from torchqm.evaluate.label_free import bijectivity
from torchqm.geometry import geodesic_solver
from torchqm.geometry.geodesic import distances
from torchqm.geometry.mesh import Mesh

FLAT = shapes.grid(3, 2, 3.0, 2.0)  # vertex 3 i + j at (i, j)


def moebius(n: int = 12) -> Mesh:
    """A band of triangles with one half turn: a manifold that has no orientation."""
    angle = 2 * np.pi * np.arange(n) / n
    radius = 1 + 0.3 * np.array([[-1], [1]]) * np.cos(angle / 2)
    verts = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.3 * np.array([[-1], [1]]) * np.sin(angle / 2)])
    here = np.stack([np.arange(n), np.arange(n) + n], 1)
    after = np.roll(here, -1, 0)
    after[-1] = after[-1, ::-1]
    a, b, c, d = *here.T, *after.T
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return Mesh.from_arrays(verts.reshape(3, -1).T, faces, "moebius")


FAN = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
TURNED = Mesh(FLAT.verts, torch.cat([FLAT.faces[:1].flip(1), FLAT.faces[1:]]), "one face turned")
TWO_FANS = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], [[0, 1, 2], [0, 3, 4]])
LOOSE = Mesh(torch.cat([FLAT.verts, torch.ones(1, 3, dtype=torch.float64)]), FLAT.faces, "loose vertex")


@pytest.mark.parametrize(
    ("mesh", "solver"),
    [
        (FLAT, "fast_marching"),
        (TURNED, "fast_marching"),
        (LOOSE, "fast_marching"),
        (FAN, "heat"),
        (TWO_FANS, "heat"),
        (moebius(), "heat"),
    ],
)
def test_the_solver_named_is_the_one_that_runs(mesh: Mesh, solver: str) -> None:
    assert solver_used(mesh) == solver
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        rows = distances(mesh, [0])
        _, named = distance_rows(mesh, torch.tensor([0]))
    assert named == solver
    assert any("heat method is used" in str(one.message) for one in told) == (solver == "heat")
    if solver == "heat":
        assert torch.equal(rows, distances(mesh, [0], method="heat"))


@pytest.mark.parametrize("method", ["heat", "dijkstra", "exact"])
def test_other_solvers_are_named_as_asked(method: str) -> None:
    assert solver_used(FAN, method) == method


def test_pairs_have_exact_distances_in_their_own_order() -> None:
    sources, targets = torch.tensor([11, 0, 4, 0, 9, 11]), torch.tensor([0, 9, 4, 2, 0, 10])
    found = pair_distances(FLAT, sources, targets, "exact")
    assert found.tolist() == pytest.approx([math.hypot(3, 2), 3.0, 0.0, 2.0, 3.0, 1.0])


@given(st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=40), st.integers(1, 5))
def test_pairs_are_entries_of_the_matrix_whatever_the_chunk(pairs: list[tuple[int, int]], rows: int) -> None:
    a, b = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).T
    matrix = distances(FLAT, list(range(12)), method="dijkstra")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchqm.evaluate.distances._CHUNK_BYTES", rows * 8 * 12)
        assert torch.equal(pair_distances(FLAT, a, b, "dijkstra"), matrix[a, b])


def test_no_more_than_a_chunk_of_rows_is_asked_for_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = count_calls(monkeypatch)
    monkeypatch.setattr("torchqm.evaluate.distances._CHUNK_BYTES", 5 * 8 * 12)
    everywhere = torch.arange(12)
    pair_distances(FLAT, everywhere, everywhere.flip(0), "dijkstra")
    assert asked == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9], [10, 11]]
    pair_distances(FLAT, everywhere, everywhere, "dijkstra")  # nothing to solve
    assert len(asked) == 3


@pytest.mark.parametrize("method", ["heat", "fast_marching"])
def test_chunks_measures_and_the_name_of_the_solver_share_one_set_up(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up, made = geodesic_solver._SET_UP[method], []
    monkeypatch.setitem(geodesic_solver._SET_UP, method, lambda surface: made.append(1) or set_up(surface))
    monkeypatch.setattr("torchqm.evaluate.distances._CHUNK_BYTES", 2 * 8 * 12)
    mesh = FLAT.moved(FLAT.verts.clone())
    everywhere = torch.arange(12)
    pair_distances(mesh, everywhere, everywhere.flip(0), method)  # six chunks
    truth = TruthDistances.build(mesh, torch.tensor([0, 3, 7]), method)
    bijectivity(mesh, everywhere.flip(0), everywhere, method=method)
    assert truth.method == method
    assert len(made) == 1


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    everywhere = torch.arange(12)
    whole = pair_distances(FLAT, everywhere, everywhere.flip(0), "dijkstra")
    asked = count_calls(monkeypatch, fail_at=3)
    monkeypatch.setattr("torchqm.evaluate.distances._CHUNK_BYTES", 4 * 8 * 12)
    with pytest.raises(KeyboardInterrupt):
        pair_distances(FLAT, everywhere, everywhere.flip(0), "dijkstra", tmp_path)
    again = pair_distances(FLAT, everywhere, everywhere.flip(0), "dijkstra", tmp_path)
    assert torch.equal(again, whole)
    assert asked == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11], [8, 9, 10, 11]]
    other = pair_distances(FLAT, everywhere, everywhere.roll(1), "dijkstra", tmp_path)  # other pairs, other entries
    assert torch.equal(other, distances(FLAT, list(range(12)), method="dijkstra")[everywhere, everywhere.roll(1)])


def test_the_solver_is_kept_with_the_rows_and_found_for_entries_without_it(tmp_path: Path) -> None:
    rows, solver = distance_rows(FAN, torch.tensor([0, 3]), "heat", tmp_path)
    (path,) = tmp_path.iterdir()
    kept = dict(np.load(path))
    assert str(kept.pop("solver")) == solver == "heat"
    np.savez(path, **kept)  # as written before solvers were kept
    again, named = distance_rows(FAN, torch.tensor([0, 3]), "heat", tmp_path)
    assert torch.equal(rows, again)
    assert named == "heat"


def test_bad_pairs_are_named() -> None:
    with pytest.raises(ValueError, match="as many of each, got 1 and 2"):
        pair_distances(FLAT, torch.tensor([0]), torch.tensor([0, 1]))
    with pytest.raises(ValueError, match=r"targets: vertices of grid must lie in 0\.\.11, got 12\.\.12"):
        pair_distances(FLAT, torch.tensor([0]), torch.tensor([12]))
    with pytest.raises(ValueError, match=r"sources: .* got -1\.\.-1"):
        pair_distances(FLAT, torch.tensor([-1]), torch.tensor([1]))


def count_calls(monkeypatch: pytest.MonkeyPatch, fail_at: int = 0) -> list[list[int]]:
    """The sources of every later call of the geodesic solver, of which one may be interrupted."""
    asked: list[list[int]] = []

    def counting(mesh: Mesh, sources: torch.Tensor, method: str = "fast_marching") -> torch.Tensor:
        asked.append(sources.tolist())
        if len(asked) == fail_at:
            raise KeyboardInterrupt
        return distances(mesh, sources, method=method)

    monkeypatch.setattr(torchqm.geometry.geodesic, "distances", counting)
    return asked
