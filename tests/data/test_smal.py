"""SMAL in both forms, with lists and without."""

from references.folders import found, write_lines, write_mesh

from torchqm.data.layouts import open_shapes

NAMES = ("cougar_1", "cow_1", "cow_2", "wolf_1")


def make(root, meshes, truth, ending):
    for k, name in enumerate(NAMES):
        write_mesh(root / meshes / f"{name}{ending}")
        write_lines(root / truth / f"{name}.vts", [6, k + 1])


def test_lists_of_ulrssm(tmp_path):
    make(tmp_path, "off", "corres", ".off")
    write_lines(tmp_path / "train.txt", ["cow_2", "cow_1", "wolf_9"])
    write_lines(tmp_path / "test.txt", ["wolf_1"])
    write_lines(tmp_path / "train_cat.txt", ["cow_1", "wolf_1"])
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "smal"
    assert shapes.classes == ["cougar", "cow", "wolf"]
    assert shapes.split() == {"train": ["cow_2", "cow_1"], "test": ["wolf_1"], "train_cat": ["cow_1", "wolf_1"]}
    assert "train.txt:3: there is no shape 'wolf_9'" in found(shapes, "missing")["wolf_9"]
    truth = shapes.truth("cougar_1", "wolf_1")  # one template for all kinds
    assert (truth.at.tolist(), truth.points.tolist()) == ([5, 0], [5, 3])


def test_kinds_of_attentive_fmaps(tmp_path):
    make(tmp_path, "shapes", "correspondences", ".obj")
    shapes = open_shapes(tmp_path)
    assert shapes.layout == "smal"
    assert shapes.split() == {"train": ["cow_1", "cow_2", "wolf_1"], "test": ["cougar_1"]}
    assert "as it has no lists" in shapes.recognised[-1]
    assert found(shapes) == {}


def test_the_animals_of_tosca_are_no_smal(tmp_path):
    for name in ("dog0", "wolf0"):
        write_mesh(tmp_path / f"off/{name}.off")
        write_lines(tmp_path / f"corres/{name}.vts", [1, 6])
    assert open_shapes(tmp_path).layout == "vts"


def test_a_folder_called_smal_is_believed(tmp_path):
    write_mesh(tmp_path / "SMAL_r/off/lynx.off")
    write_lines(tmp_path / "SMAL_r/corres/lynx.vts", [1, 6])
    assert open_shapes(tmp_path / "SMAL_r").layout == "smal"
