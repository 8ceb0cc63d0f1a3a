"""torchqm.spectral.cache: what is read is what was computed, whatever happens to files, in any number of processes."""

import io
import json
import os
import signal
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.shapes import basis_of, blob, icosphere, prism

from torchqm.geometry import Mesh
from torchqm.spectral import (
    CacheWarning,
    SpectralBasis,
    SpectrumError,
    cache,
    cache_file,
    cache_folder,
    cached_basis,
    cluster_end,
    mesh_basis,
    read_basis,
)
from torchqm.spectral.cache import is_cached
from torchqm.testing import basis_allclose

MESH = blob(1, 2).mesh  # 162 vertices: solved densely, so that an eigen-solve takes milliseconds


def same(basis: SpectralBasis, mesh: Mesh, k: int) -> bool:
    """Whether it is the basis of the mesh that is computed without a cache."""
    truth = basis_of(mesh, k)
    return (
        basis.k == k
        and bool(torch.allclose(basis.evals, truth.evals, rtol=1e-9, atol=1e-9))
        and basis_allclose(basis.evecs, truth.evecs, truth.evals, truth.mass)
        and torch.equal(basis.mass, truth.mass)
    )


def entries(folder):
    return sorted(p.name for p in folder.iterdir() if p.is_file())


def quietly(*args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return cached_basis(*args, **options)


def test_the_second_call_reads_the_bits_of_the_first(tmp_path, mirror_blob):
    first = quietly(mirror_blob.mesh, 20, cache_dir=tmp_path / "new" / "folder")
    again = quietly(mirror_blob.mesh, 20, cache_dir=tmp_path / "new" / "folder")
    assert (first.report.outcome, again.report.outcome) == ("computed", "read")
    assert same(first, mirror_blob.mesh, 20)
    for name in ("evals", "evecs", "mass"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert getattr(again, name).dtype == torch.float64
    for report in (first.report, again.report):
        assert report.kind == "cotan"
        assert report.reason.startswith("manifold, no flat triangle")
        assert report.source.startswith("torchqm ")
        assert report.path.parent == tmp_path / "new" / "folder"
        assert not report.problems
    assert entries(tmp_path / "new" / "folder") == [first.report.path.name]


def test_an_entry_loads_without_pickle_and_holds_what_it_says(tmp_path):
    basis = quietly(MESH, 9, cache_dir=tmp_path)
    with np.load(basis.report.path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files}
    assert not any(array.dtype.hasobject for array in content.values())
    assert content["evecs"].shape == (162, 9)
    assert {content[name].dtype for name in ("evals", "evecs", "mass")} == {np.dtype("float64")}
    assert str(content["name"]) == MESH.name
    assert str(content["kind"]) == "cotan"
    assert float(content["next_eval"]) == pytest.approx(float(basis_of(MESH, 10).evals[9]))
    assert basis.report.path.name == f"{cache_file.content_hash(MESH)}-auto-k9-v1.npz"


@pytest.mark.parametrize("k", [1, 7, 29])
def test_a_larger_entry_serves_fewer_functions(tmp_path, k):
    quietly(MESH, 30, cache_dir=tmp_path)
    basis = quietly(MESH, k, cache_dir=tmp_path)
    assert basis.report.outcome == "read"
    assert same(basis, MESH, k)
    assert basis.evecs.is_contiguous()
    assert len(entries(tmp_path)) == 1


def test_more_functions_replace_the_entry(tmp_path):
    for k in (5, 12):
        assert quietly(MESH, k, cache_dir=tmp_path).report.outcome == "computed"
    assert [name.split("-")[2] for name in entries(tmp_path)] == ["k12"]


@pytest.mark.parametrize("make", [lambda: icosphere(2), lambda: prism().mesh], ids=["sphere", "prism"])
def test_never_cut_through_a_cluster_and_never_another_answer_from_another_entry(tmp_path, make):
    mesh = make()
    evals = basis_of(mesh, 30).evals
    whole = [cluster_end(evals, k, cache.CLUSTER_RTOL) for k in range(1, 19)]
    cut = [k for k in range(1, 19) if whole[k - 1] < k]  # such k would go through a cluster
    assert len(cut) > 2
    for k in (cut[0], cut[-1], 18):
        fresh = quietly(mesh, k, cache_dir=tmp_path / f"{k}")
        assert fresh.k == whole[k - 1]
        assert bool(fresh.report.notes) == (k in cut)
        served = [quietly(mesh, n, cache_dir=tmp_path / f"{k}") for n in range(1, k + 1)]
        assert [basis.k for basis in served] == whole[:k]
        assert {basis.report.outcome for basis in served} == {"read"}
    exact = quietly(mesh, cut[0], cache_dir=tmp_path / "18", whole_clusters=False)
    assert (exact.k, exact.report.outcome, exact.report.notes) == (cut[0], "read", ())


def test_all_functions_there_are(tmp_path):
    mesh = icosphere(1)
    assert quietly(mesh, 42, cache_dir=tmp_path).k == 42
    assert quietly(mesh, 42, cache_dir=tmp_path).report.outcome == "read"
    for k in (0, 43):
        with pytest.raises(SpectrumError, match=rf"{k} eigenpairs asked for, .* 1\.\.42"):
            cached_basis(mesh, k, cache_dir=tmp_path)
    with pytest.raises(ValueError, match="kind is 'best'; allowed are 'auto', 'cotan' and 'robust'"):
        cached_basis(mesh, 3, "best", tmp_path)


def test_the_key_is_the_content(tmp_path):
    quietly(MESH, 5, cache_dir=tmp_path)
    renamed = Mesh(MESH.verts.clone(), MESH.faces.clone(), "other", tmp_path / "other.off")
    assert quietly(renamed, 5, cache_dir=tmp_path).report.outcome == "read"
    moved = MESH.verts.clone()
    moved[7, 1] = np.nextafter(float(moved[7, 1]), 9.0)
    turned = MESH.faces.clone()
    turned[3] = turned[3].roll(1)
    for other in (MESH.moved(moved), Mesh(MESH.verts, turned), Mesh(MESH.verts, MESH.faces[:-1])):
        assert read_basis(other, 5, cache_dir=tmp_path) is None
        assert quietly(other, 5, cache_dir=tmp_path).report.outcome == "computed"


def test_laplacians_are_kept_apart_and_auto_serves_the_kind_it_chose(tmp_path):
    robust = quietly(MESH, 6, "robust", tmp_path)
    assert robust.report.kind == "robust"
    assert quietly(MESH, 6, "auto", tmp_path).report.outcome == "computed"
    assert quietly(MESH, 6, "cotan", tmp_path).report.outcome == "read"  # auto took cotan
    assert torch.equal(quietly(MESH, 6, "robust", tmp_path).evals, robust.evals)
    assert len(entries(tmp_path)) == 2
    flat = Mesh(MESH.verts, torch.cat([MESH.faces, MESH.faces[:1].flip(1) * 0 + torch.tensor([0, 1, 161])]))
    kinds = [quietly(flat, 6, kind, tmp_path).report for kind in ("auto", "cotan", "robust")]
    assert [report.kind for report in kinds] == ["robust", "cotan", "robust"]
    assert [report.outcome for report in kinds] == ["computed", "computed", "read"]


def test_scaled_basis_is_the_basis_of_the_scaled_mesh(tmp_path):
    factor = MESH.area**-0.5
    scaled = quietly(MESH, 12, cache_dir=tmp_path).scaled(factor)
    truth = mesh_basis(MESH.moved(MESH.verts * factor), 12)
    torch.testing.assert_close(scaled.evals, truth.evals, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(scaled.evecs, truth.evecs, rtol=0, atol=1e-8)
    torch.testing.assert_close(scaled.mass, truth.mass)
    assert float(scaled.mass.sum()) == pytest.approx(1)


def test_the_folder_is_the_one_given_else_of_the_environment_else_none(tmp_path, monkeypatch):
    monkeypatch.delenv(cache.CACHE_VARIABLE, raising=False)
    assert cache_folder() is None
    assert cache_folder(None, tmp_path) == tmp_path
    plain = quietly(MESH, 4)
    assert (plain.report.path, plain.report.outcome) == (None, "computed")
    assert read_basis(MESH, 4) is None
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "env"))
    assert cache_folder(None, tmp_path) == tmp_path / "env"
    assert cache_folder(tmp_path) == tmp_path
    assert quietly(MESH, 4).report.path.parent == tmp_path / "env"
    assert read_basis(MESH, 4).report.outcome == "read"


# --- damage ---------------------------------------------------------------------------------------------------------


def swap(path, **changes):
    """The same entry with other content."""
    with np.load(path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files}
    content |= changes
    np.savez(path, **{name: array for name, array in content.items() if array is not None})


def npy():
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


def pickled(path):
    np.savez(path, evals=np.array([{"a": 1}], dtype=object))


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("not an archive"),
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "npy": lambda path: path.write_bytes(npy()),
    "pickle": pickled,
    "other program": lambda path: np.savez(path, evals=np.zeros(5)),
    "other mesh": lambda path: swap(path, content="0" * 32),
    "other kind": lambda path: swap(path, asked="robust"),
    "other version": lambda path: swap(path, version=0),
    "fewer": lambda path: swap(path, evals=np.zeros(3)),
    "single precision": lambda path: swap(path, evecs=np.zeros((162, 5), np.float32)),
    "nan": lambda path: swap(path, evecs=np.full((162, 5), np.nan)),
    "not orthonormal": lambda path: swap(path, evecs=np.ones((162, 5))),
    "descending": lambda path: swap(path, evals=np.arange(5.0)[::-1]),
    "negative mass": lambda path: swap(path, mass=-np.ones(162)),
    "no reason": lambda path: swap(path, reason=None),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_or_foreign_entry_is_rebuilt_and_reported(tmp_path, damage):
    path = quietly(MESH, 5, cache_dir=tmp_path).report.path
    sound = path.read_bytes()
    DAMAGE[damage](path)
    with pytest.warns(CacheWarning, match="damaged or foreign") as caught:
        basis = cached_basis(MESH, 5, cache_dir=tmp_path)
    assert str(path) in str(caught[0].message)
    assert len(caught) == 1
    assert basis.report.outcome == "rebuilt"
    assert basis.report.problems == (str(caught[0].message),)
    assert same(basis, MESH, 5)
    assert len(path.read_bytes()) == len(sound)
    assert quietly(MESH, 5, cache_dir=tmp_path).report.outcome == "read"
    assert entries(tmp_path) == [path.name]


def test_a_damaged_entry_of_another_size_goes_away(tmp_path):
    path = quietly(MESH, 9, cache_dir=tmp_path).report.path
    path.write_bytes(b"gone")
    with pytest.warns(CacheWarning, match="k9"):
        assert same(cached_basis(MESH, 5, cache_dir=tmp_path), MESH, 5)
    assert [name.split("-")[2] for name in entries(tmp_path)] == ["k5"]
    larger = quietly(MESH, 9, cache_dir=tmp_path / "b").report.path.read_bytes()
    (tmp_path / path.name).write_bytes(larger)
    (tmp_path / path.name.replace("k9", "k5")).write_bytes(larger)  # a whole entry under the name of another
    with pytest.warns(CacheWarning, match=r"k5.*evals is float64 \(9,\)"):
        served = cached_basis(MESH, 5, cache_dir=tmp_path)
    assert served.report.outcome == "read"
    assert same(served, MESH, 5)
    assert entries(tmp_path) == [path.name]


def test_an_entry_that_cannot_be_read_is_told_and_not_deleted(tmp_path, monkeypatch):
    path = quietly(MESH, 9, cache_dir=tmp_path).report.path

    def refuse(*arguments):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(cache, "read_entry", refuse)
    with pytest.warns(CacheWarning, match=rf"{path.name}: cannot be read \(Permission denied\)"):
        basis = cached_basis(MESH, 5, cache_dir=tmp_path)
    assert same(basis, MESH, 5)
    assert basis.report.outcome == "computed"
    assert path.exists()


def test_files_of_others_are_left_alone(tmp_path):
    digest = cache_file.content_hash(MESH)
    names = [
        "notes.txt",
        f"{digest}.npz",
        f"{digest}-auto-k0-v1.npz",
        f"{digest}-auto-kx-v1.npz",
        f"{digest}-a-k9-v1.npz",
    ]
    for name in names:
        (tmp_path / name).write_text("mine")
    assert quietly(MESH, 5, cache_dir=tmp_path).report.outcome == "computed"
    assert all((tmp_path / name).read_text() == "mine" for name in names)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = quietly(MESH, 5, cache_dir=tmp_path_factory.mktemp("sound")).report.path
    return path, path.read_bytes()


@given(data=st.data())
def test_no_damage_changes_the_answer(sound, data):
    """Cut anywhere, or with any byte changed: the right basis comes back, with a warning where it was rebuilt."""
    path, content = sound
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        broken = content[:at]
    else:
        broken = content[:at] + bytes([content[at] ^ data.draw(st.integers(1, 255))]) + content[at + 1 :]
    path.write_bytes(broken)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        basis = cached_basis(MESH, 5, cache_dir=path.parent)
    assert same(basis, MESH, 5)
    assert (basis.report.outcome == "rebuilt") == any(issubclass(w.category, CacheWarning) for w in caught)
    if len(broken) < len(content):
        assert basis.report.outcome == "rebuilt"


@pytest.mark.parametrize("where", ["file", "below a file"])
def test_a_folder_that_cannot_be_written_to_is_told_and_the_basis_is_right(tmp_path, where):
    (tmp_path / "file").write_text("")
    folder = tmp_path / "file" / ("" if where == "file" else "deeper")
    with pytest.warns(CacheWarning, match=r"file.*cannot be written"):
        basis = cached_basis(MESH, 5, cache_dir=folder)
    assert same(basis, MESH, 5)
    assert basis.report.path is None


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache_file.np, "savez", full)
    with pytest.warns(CacheWarning, match="cannot be written .No space left on device"):
        basis = cached_basis(MESH, 5, cache_dir=tmp_path)
    assert same(basis, MESH, 5)
    assert entries(tmp_path) == []


# --- processes ------------------------------------------------------------------------------------------------------

CROWD = """
import json, os, signal, sys, time
from pathlib import Path
import torch
from references.shapes import blob
from torchqm.spectral import cache, cache_file

torch.set_num_threads(1)
folder = Path(sys.argv[1])
mesh, plain = blob(1, 2).mesh, cache.eigenbasis_and_note
truth = cache.cached_basis(mesh, 8)

def logged(*arguments):
    with open(folder / "computed", "a") as log:
        log.write(f"{os.getpid()}\\n")
    time.sleep(0.2)
    return plain(*arguments)

def once(number):
    cache.eigenbasis_and_note = logged
    basis = cache.cached_basis(mesh, 8, cache_dir=folder / "once")
    return torch.equal(basis.evecs, truth.evecs) and not basis.report.problems

def mixed(number):
    for turn in range(25):  # readers, writers of two sizes, and one that deletes
        k = 8 if (number + turn) % 2 else 5
        basis = cache.cached_basis(mesh, k, cache_dir=folder / "mixed")
        if basis.k != k or basis.report.problems or not torch.allclose(basis.evecs, truth.evecs[:, :k], atol=1e-9):
            return False
        if number == 0:
            for path in (folder / "mixed").glob("*.npz"):
                path.unlink(missing_ok=True)
    return True

def killed(number):
    def die(file, **arrays):
        file.write(b"half of it")
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    cache_file.np.savez = die
    cache.cached_basis(mesh, 5, cache_dir=folder / "killed")

codes = {}
for work, count in ((once, 5), (mixed, 5), (killed, 1)):
    wait, go = os.pipe()
    children = []
    for number in range(count):
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.read(wait, 1)  # all at once
                code = 0 if work(number) else 3
            finally:
                os._exit(code)
        children.append(pid)
    os.write(go, b"." * count)
    codes[work.__name__] = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in children]
print(json.dumps(codes))
"""


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    """A folder in which several processes worked at once, and how each of them ended (0: all that it saw was right)."""
    folder = tmp_path_factory.mktemp("crowd")
    tests = os.path.dirname(os.path.dirname(__file__))
    environment = os.environ | {"PYTHONPATH": tests, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", CROWD, str(folder)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert run.stderr == ""  # no warning: nobody met half a file, or thought that one was damaged
    return folder, json.loads(run.stdout)


def test_many_processes_ask_for_one_entry_and_one_computes_it(crowd):
    folder, codes = crowd
    assert codes["once"] == [0] * 5
    assert len((folder / "computed").read_text().split()) == 1
    assert len(entries(folder / "once")) == 1


def test_readers_writers_and_a_deleter_at_once(crowd):
    folder, codes = crowd
    assert codes["mixed"] == [0] * 5
    assert all(name.endswith(".npz") for name in entries(folder / "mixed"))


def test_killed_while_writing(crowd):
    folder, codes = crowd
    assert codes["killed"] == [-signal.SIGKILL]
    assert [name.endswith(".part") for name in entries(folder / "killed")] == [True]
    basis = quietly(MESH, 5, cache_dir=folder / "killed")  # no lock is held, and the half is neither read nor kept
    assert basis.report.outcome == "computed"
    assert entries(folder / "killed") == [basis.report.path.name]


def test_without_locks_work_is_done_twice_and_nothing_else(tmp_path, monkeypatch):
    import filelock

    def refuse(*arguments, **options):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    assert same(quietly(MESH, 5, cache_dir=tmp_path), MESH, 5)
    assert quietly(MESH, 5, cache_dir=tmp_path).report.outcome == "read"


def test_a_holder_that_hangs_is_not_waited_for_without_end(tmp_path, monkeypatch):
    import filelock

    (tmp_path / "locks").mkdir()
    monkeypatch.setattr(cache, "LOCK_SECONDS", 0.05)
    with filelock.FileLock(tmp_path / "locks" / f"{cache_file.content_hash(MESH)}-auto.lock"):
        assert same(quietly(MESH, 5, cache_dir=tmp_path), MESH, 5)
    assert len(entries(tmp_path)) == 1


def test_is_cached_says_whether_an_entry_would_serve(tmp_path):
    mesh = blob(2, 2).mesh
    assert not is_cached(mesh, 8, cache_dir=tmp_path)
    cached_basis(mesh, 8, cache_dir=tmp_path)
    assert is_cached(mesh, 8, cache_dir=tmp_path)
    assert is_cached(mesh, 5, cache_dir=tmp_path)
    assert not is_cached(mesh, 9, cache_dir=tmp_path)
    assert not is_cached(blob(4, 2).mesh, 8, cache_dir=tmp_path)
    assert not is_cached(mesh, 8, "other", tmp_path)
