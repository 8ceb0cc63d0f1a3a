"""Symmetries of a run: found once, the same as without files, their seconds counted for every pair."""

import pytest
import torch

from torchqm.benchmark.symmetries import KeptCollection, load_known, match_ours, save_known
from torchqm.data.synthetic import creature
from torchqm.matching import MatchParameters, prepare
from torchqm.matching.baselines import Given, Ours
from torchqm.matching.known import extrinsic_symmetry, transferred_symmetry

PARAMETERS = MatchParameters(k=20, k_quotient=30, k_max=40, n_samples=300, icp_steps=5)


@pytest.fixture(scope="module")
def pair():
    """A posed biped and its rest pose, whose plane is firm."""
    return [prepare(creature("biped", 600, 0, pose).mesh, 40) for pose in (1, 0)]


def test_a_symmetry_comes_back_from_its_file(tmp_path, pair):
    known = extrinsic_symmetry(pair[1])
    path = tmp_path / "s.npz"
    assert load_known(path, pair[1].n_verts) is None
    save_known(path, known, 1.5)
    found, seconds = load_known(path, pair[1].n_verts)
    assert seconds == 1.5
    assert torch.equal(found.group.maps, known.group.maps)
    assert torch.equal(found.sign, known.sign)
    assert (found.origin, found.warnings, found.name) == (known.origin, known.warnings, known.name)
    with pytest.warns(UserWarning, match=r"s\.npz: a kept symmetry that cannot be used.* instead of 7"):
        assert load_known(path, 7) is None
    path.write_bytes(path.read_bytes()[:100])
    with pytest.warns(UserWarning, match=r"s\.npz: a kept symmetry that cannot be used"):
        assert load_known(path, pair[1].n_verts) is None


@pytest.mark.parametrize("axis", ["auto", "reference"])
def test_a_match_is_that_of_the_method_and_symmetries_are_found_once(tmp_path, pair, axis, monkeypatch):
    x, y = pair
    matcher, given = Ours(axis=axis, parameters=PARAMETERS), Given(reference=y)
    calls = []

    def transfer(*arguments):
        calls.append(arguments[0].mesh.name)
        return transferred_symmetry(*arguments)

    monkeypatch.setattr("torchqm.matching.collection.transferred_symmetry", transfer)
    plain = matcher.match(x, y, given)
    results = [match_ours(matcher, x, y, given, KeptCollection(tmp_path, "quotient", PARAMETERS)) for _ in range(2)]
    assert len(calls) == 2  # once by the method itself, once for both of these
    for result in results:
        assert torch.equal(result.maps, plain.maps)
        assert result.labels == plain.labels
    first, second = (result.steps["symmetries"] for result in results)
    assert first == pytest.approx(second, rel=1e-6)
    assert first > 0
    assert results[0].steps["matching"] > 0
    assert len(list(tmp_path.glob("*.npz"))) >= 2


def test_other_parameters_are_another_symmetry(tmp_path, pair):
    y = pair[1]
    for parameters in (PARAMETERS, PARAMETERS.changed(seed=1)):
        KeptCollection(tmp_path, "quotient", parameters).symmetry(y)
    assert len(list(tmp_path.glob("*.npz"))) == 2
