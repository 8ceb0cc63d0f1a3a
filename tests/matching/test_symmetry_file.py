import numpy as np
import pytest
import torch

from torchqm.data.synthetic import creature
from torchqm.matching.symmetry_file import SymmetryFileError, load_symmetry, return_error


@pytest.fixture
def shape(mirror_blob):
    return mirror_blob


@pytest.fixture
def reflection(shape):
    return shape.group.maps[1].numpy()


def text_of(ids):
    return "\n".join(map(str, ids)) + "\n"


def test_symmetry_npz_as_it_is_written(tmp_path, shape):
    np.savez(
        tmp_path / "s.npz", maps=shape.group.maps.numpy(), labels=np.array(["direct", "mirrored"]), scores=[0.0, 0.1]
    )
    read = load_symmetry(tmp_path / "s.npz", shape.mesh)
    assert torch.equal(read.maps, shape.group.maps)
    assert read.notes == []


@pytest.mark.parametrize("form", ["npy", "column", "float", "txt", "csv", "table"])
def test_one_reflection_in_every_form(tmp_path, shape, reflection, form):
    path = tmp_path / ("s.txt" if form in ("txt", "table") else "s.csv" if form == "csv" else "s.npy")
    if form == "txt":
        path.write_text(text_of(reflection))
    elif form == "csv":
        path.write_text(",".join(map(str, reflection)))
    elif form == "table":
        np.savetxt(path, shape.group.maps.numpy(), fmt="%d")
    else:
        np.save(path, {"npy": reflection, "column": reflection[:, None], "float": reflection.astype(float)}[form])
    read = load_symmetry(path, shape.mesh)
    assert torch.equal(read.maps, shape.group.maps)
    assert read.notes == []


def test_ids_counted_from_one_are_recognised_and_reported(tmp_path, shape, reflection):
    path = tmp_path / "cat.vts"
    path.write_text(text_of(reflection + 1))
    read = load_symmetry(path, shape.mesh)
    assert torch.equal(read.maps, shape.group.maps)
    assert len(read.notes) == 1
    assert "cat.vts" in read.notes[0]
    assert "count from 1" in read.notes[0]


def test_nearest_vertex_map_is_accepted_with_both_numbers(tmp_path, shape, reflection):
    a, b = shape.mesh.edges[0].tolist()
    ids = reflection.copy()
    ids[np.flatnonzero(reflection == a)] = b  # now two vertices go to b, and none to a
    np.save(tmp_path / "near.npy", ids)
    read = load_symmetry(tmp_path / "near.npy", shape.mesh)
    assert read.maps[1].tolist() == ids.tolist()
    assert "1 of 642 ids repeat" in read.notes[0]
    assert f"{return_error(shape.mesh, torch.from_numpy(ids)):.3f}" in read.notes[0]


@pytest.mark.parametrize("scale", [1e-150, 1e-50, 1, 1e3, 1e50, 1e150])
def test_return_error_does_not_depend_on_the_scale(shape, scale):
    turned = torch.roll(torch.arange(642), 1)
    mesh = shape.mesh.moved(shape.mesh.verts * scale)
    assert return_error(mesh, shape.group.maps[1]) == 0
    moved = (shape.mesh.verts - shape.mesh.verts[turned[turned]]).norm(dim=1)
    mean = float((moved * shape.mesh.vertex_areas).sum()) / shape.mesh.area
    assert mean > 0
    assert return_error(mesh, turned) == pytest.approx(mean / shape.mesh.area**0.5)


def test_a_map_that_is_no_reflection_is_refused_with_its_number_at_any_scale(tmp_path, shape):
    np.save(tmp_path / "s.npy", np.random.default_rng(0).permutation(642))
    messages = []
    for scale in (1, 1e-150, 1e150):
        with pytest.raises(SymmetryFileError, match=r"moves points by 0\.\d+ sqrt\(area\)") as error:
            load_symmetry(tmp_path / "s.npy", shape.mesh.moved(shape.mesh.verts * scale))
        messages.append(str(error.value))
    assert len(set(messages)) == 1


FAULTS = {
    "missing": "no such file",
    "folder": "is a folder",
    "ending": "unknown ending '.dat'",
    "empty": "is empty",
    "binary": "not a text file",
    "words": "'left' in row 2 is no vertex id",
    "ragged": "rows of different length",
    "damaged": "damaged",
    "pickled": "damaged, or no NumPy file without pickled objects",
    "no key": "no key 'maps'",
    "match": "the result of a match",
    "fractions": "integers",
    "short": "641 entries a map, but blob2 has 642 vertices",
    "long": "643 entries",
    "high": "1 ids out of range",
    "negative": "run from -1",
    "identity": "is the identity",
    "no identity": "row 0",
    "constant": r"no permutation \(641 of 642 ids repeat\) and no reflection",
    "random": "a permutation, but no reflection",
    "cube": "shape",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_name_the_file_and_what_is_wrong(tmp_path, shape, reflection, fault):
    ids = reflection.copy()
    path = tmp_path / {"ending": "s.dat", "folder": "s"}.get(fault, "s.npy")
    if fault == "folder":
        path.mkdir()
    elif fault in ("empty", "ending"):
        path.write_text("" if fault == "empty" else text_of(ids))
    elif fault in ("binary", "words", "ragged"):
        path = tmp_path / "s.txt"
        path.write_bytes({"binary": b"\xff\xfe\x00", "words": b"1\nleft\n", "ragged": b"1 2\n3\n"}[fault])
    elif fault == "damaged":
        np.save(path, ids)
        path.write_bytes(path.read_bytes()[:200])
    elif fault == "pickled":
        np.save(path, np.array([{}]), allow_pickle=True)
    elif fault in ("no key", "match"):
        path = tmp_path / "s.npz"
        np.savez(path, **({"p2p": ids} if fault == "no key" else {"maps": ids[None], "orbits": ids[:, None]}))
    elif fault != "missing":
        high = ids.copy()
        high[3] = 642 + 10
        negative = ids.copy()
        negative[3] = -1
        np.save(
            path,
            {
                "fractions": ids + 0.5,
                "short": ids[:-1],
                "long": np.append(ids, 0),
                "high": high,
                "negative": negative,
                "identity": np.arange(642),
                "no identity": np.stack([ids, np.arange(642)]),
                "constant": np.full(642, 5),
                "random": np.random.default_rng(0).permutation(642),
                "cube": ids.reshape(1, 1, -1),
            }[fault],
        )
    with pytest.raises(SymmetryFileError, match=FAULTS[fault]) as error:
        load_symmetry(path, shape.mesh)
    assert str(error.value).startswith(str(path))


def test_a_half_turn_is_read_beside_the_identity_and_refused_alone(tmp_path):
    """Alone in a file it would be taken for a reflection, and labels would be wrong."""
    body = creature("ellipsoid", 1000)
    turn = body.base_group[int((body.orientation > 0).nonzero()[1])]
    assert torch.equal(turn[turn], torch.arange(body.mesh.n_verts))
    both, alone = tmp_path / "both.npy", tmp_path / "alone.npy"
    np.save(both, torch.stack([torch.arange(body.mesh.n_verts), turn]).numpy())
    np.save(alone, turn.numpy())
    assert torch.equal(load_symmetry(both, body.mesh).maps[1], turn)
    with pytest.raises(SymmetryFileError, match=r"alone\.npy: .*keeps the orientation of the surface"):
        load_symmetry(alone, body.mesh)
