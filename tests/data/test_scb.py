"""The reader of the SCB folder, on a synthetic folder and, where it is at hand, on the real one."""

import os
from pathlib import Path

import pytest

from torchqm.data.published import RESULT_FOLDER
from torchqm.data.scb import SCBenchmark, shape_class

REAL = os.environ.get("TORCHQM_SCB")
BLOCK = "Stats:\n\tAverage\t[0.1]\n\tPerSampleErrors\t[0.1]\n"


def write_off(path: Path, n_verts: int, header: str = "OFF") -> None:
    path.write_text(f"{header}\n{n_verts} 1 0\n" + "0 0 0\n" * n_verts + "3 0 1 2\n")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Cats 0, 2, 10 agree and cat11 does not; dogs are numbered otherwise than the results; wolf has two meshes."""
    meshes, corrs, results = tmp_path / "TOSCA/Meshes", tmp_path / "TOSCA/Corrs", tmp_path / RESULT_FOLDER
    for folder in (meshes, corrs, results):
        folder.mkdir(parents=True)
    for name in ("cat0", "cat2", "cat10", "dog", "dog0", "dog1", "wolf0", "wolf1"):
        write_off(meshes / f"{name}.off", 5)
    write_off(meshes / "cat11.off", 4, "NOFF")
    (corrs / "cat.pid").write_text("  4 0 0 0\n 1 0 0 0\n 2 0 0 0\n")
    (corrs / "cat.sym.info").write_text("1 2 \n\n0\n\n\n")
    (corrs / "cat.info").write_text("0: tip of head/mouth\n\n1:left ear\nbroken line\n2: right ear \n")
    for pair in (
        "cat10_to_cat0",
        "cat2_to_cat10",
        "cat0_to_cat11",
        "dog0_to_dog1",
        "dog1_to_dog8",
        "wolf0_to_wolf1",
        "wolf1_to_wolf2",
    ):
        (results / f"BenchResult_BlendedMap_{pair}.txt").write_text(BLOCK)
    return tmp_path


def test_classes_shapes_and_paths(root: Path) -> None:
    scb = SCBenchmark(root)
    assert scb.classes == ["cat", "dog", "wolf"]
    assert scb.shapes("cat") == ["cat0", "cat2", "cat10"]
    assert scb.shapes() == ["cat0", "cat2", "cat10", "dog", "dog0", "dog1", "wolf0", "wolf1"]
    assert scb.n_verts("cat") == 5
    assert scb.mesh_path("cat10") == root / "TOSCA/Meshes/cat10.off"
    assert scb.undeformed("cat") == "cat0"


def test_a_shape_with_another_vertex_count_is_excluded_with_the_reason(root: Path) -> None:
    scb = SCBenchmark(root)
    assert list(scb.excluded) == ["cat11"]
    assert "4 vertices where class 'cat' has 5" in scb.excluded["cat11"]
    assert scb.mesh_path("cat11").is_file()


def test_landmarks_and_their_symmetry(root: Path) -> None:
    scb = SCBenchmark(root)
    assert scb.landmarks("cat").tolist() == [4, 1, 2]
    symmetry = scb.symmetry_landmarks("cat")
    assert symmetry.pairs.tolist() == [[1, 2]]
    assert symmetry.fixed.tolist() == [0]
    assert symmetry.permutation().tolist() == [0, 2, 1]
    assert scb.landmark_names("cat") == {0: "tip of head/mouth", 1: "left ear", 2: "right ear"}


def test_published_pairs_leave_out_what_cannot_be_compared(root: Path) -> None:
    scb = SCBenchmark(root)
    assert scb.published_pairs("cat") == [("cat2", "cat10"), ("cat10", "cat0")]
    assert scb.published_pairs() == [("cat2", "cat10"), ("cat10", "cat0"), ("wolf0", "wolf1")]
    skipped = scb.skipped_pairs()
    assert "4 vertices" in skipped["cat0", "cat11"]
    assert "wolf2.off" in skipped["wolf1", "wolf2"]
    # dog8 has a result and no mesh, "dog" a mesh and no result: renumbered, so dog0 -> dog1 is not trusted either
    assert "numbered differently" in skipped["dog0", "dog1"]
    assert "no mesh for dog8" in skipped["dog0", "dog1"]


def test_renumbered_classes_can_be_run_but_not_compared(root: Path) -> None:
    scb = SCBenchmark(root)
    assert scb.published_pairs("dog") == []
    assert scb.published_pairs("dog", by_name=False) == [("dog0", "dog1")]
    assert list(scb.skipped_pairs("dog", by_name=False)) == [("dog1", "dog8")]


def test_missing_things_are_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"TOSCA/Meshes is not a folder; .* was expected"):
        SCBenchmark(tmp_path / "nowhere")
    (tmp_path / "empty/TOSCA/Meshes").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=r"has no \.off files"):
        SCBenchmark(tmp_path / "empty")
    scb = SCBenchmark(root)
    with pytest.raises(FileNotFoundError, match=r"cat7\.off does not exist; shapes here: cat0, cat2"):
        scb.mesh_path("cat7")
    with pytest.raises(FileNotFoundError, match=r"dog\.pid does not exist"):
        scb.landmarks("dog")
    with pytest.raises(ValueError, match=r"'horse' has no mesh .* classes here: cat, dog, wolf"):
        scb.shapes("horse")
    with pytest.raises(FileNotFoundError, match="BenchResult_Mine_"):
        scb.published_pairs(method="Mine")


@pytest.mark.parametrize(
    ("suffix", "text", "message"),
    [
        ("pid", "1 0 0 0\nx 0 0 0\n", r"cat\.pid:2: expected a vertex id"),
        ("pid", "5 0 0 0\n", r"cat\.pid:1: vertex 5, but class 'cat' has 5 vertices"),
        ("pid", "1 0.5 0.5 0\n", r"cat\.pid:1: expected a vertex id and three zeros"),
        ("pid", "\n", r"cat\.pid: no landmarks"),
        ("sym.info", "0 1 2\n", r"cat\.sym\.info:1: expected one or two landmark numbers"),
        ("sym.info", "0\n1 a\n", r"cat\.sym\.info:2: expected one or two landmark numbers"),
        ("sym.info", "1 2\n", r"cat\.sym\.info: each of the 3 landmarks must be named once, these are not: \[0\]"),
        ("sym.info", "1 2\n0\n0\n", r"these are not: \[0\]"),
        ("sym.info", "1 2\n0\n3\n", r"these are not: \[3\]"),
    ],
)
def test_malformed_landmark_files_are_named(root: Path, suffix: str, text: str, message: str) -> None:
    (root / f"TOSCA/Corrs/cat.{suffix}").write_text(text)
    with pytest.raises(ValueError, match=message):
        SCBenchmark(root).symmetry_landmarks("cat")


@pytest.mark.parametrize("text", ["", "PLY\n5 1 0\n", "OFF\nmany 1 0\n"])
def test_a_file_that_is_no_off_file_is_named(root: Path, text: str) -> None:
    (root / "TOSCA/Meshes/cat2.off").write_text(text)
    with pytest.raises(ValueError, match=r"cat2\.off: not an OFF file"):
        SCBenchmark(root).shapes("cat")


def test_counts_on_the_header_line_and_comments_are_read(root: Path) -> None:
    (root / "TOSCA/Meshes/cat2.off").write_text("# a comment\nOFF 5 1 0\n")
    assert SCBenchmark(root).shapes("cat") == ["cat0", "cat2", "cat10"]


def test_shape_class() -> None:
    assert [shape_class(name) for name in ("victoria21", "dog", "cat0")] == ["victoria", "dog", "cat"]


@pytest.mark.skipif(not REAL, reason="TORCHQM_SCB does not point to an SCB folder")
def test_real_folder() -> None:
    scb = SCBenchmark(str(REAL))
    assert set(scb.excluded) & set(scb.shapes()) == set()
    for cls in scb.classes:
        assert len(scb.symmetry_landmarks(cls).permutation()) == len(scb.landmarks(cls))
    if len(scb.classes) == 9:
        assert set(scb.excluded) == {"cat11", "cat12", "centaur6"}
        assert len(scb.published_pairs()) == 71
        assert len(scb.published_pairs(by_name=False)) == 77
        assert {shape_class(source) for source, _ in scb.skipped_pairs()} == {"dog"}
