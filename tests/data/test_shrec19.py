"""SHREC19: maps between pairs, and the shape that nobody counts."""

import pytest
from references.folders import found, write_lines, write_mesh

from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes


@pytest.fixture(
    params=[
        ("off", "corres", ".off", 1),
        ("shapes", "correspondences", ".off", 0),
        ("shapes", "groundtruth", ".obj", 1),
    ]
)
def set_(request, tmp_path):
    """Shapes of 6, 7 and 6 vertices, and the partial one."""
    meshes, truth, ending, base = request.param
    for name, count in (("1", 6), ("2", 7), ("10", 6), ("40", 5)):
        write_mesh(tmp_path / meshes / f"{name}{ending}", count)
    folder = tmp_path / truth
    write_lines(folder / "1_2.map", [i + base for i in (6, 0, 0, 3, 2, 1)])
    write_lines(folder / "10_1.map", [i + base for i in (5, 4, 3, 2, 1, 0)])
    write_lines(folder / "1_40.map", [base] * 6)
    return tmp_path, folder, base


def test_maps_in_either_direction_without_shape_40(set_):
    root, _, base = set_
    shapes = open_shapes(root)
    assert shapes.layout == "shrec19"
    assert shapes.names == ["1", "2", "10"]
    assert shapes.published_pairs() == [("1", "2"), ("10", "1")]
    assert any(f"{base}-based" in sentence for sentence in shapes.recognised)
    assert any("shape 40 and 1 maps of it" in sentence for sentence in shapes.recognised)
    truth = shapes.truth("1", "2")
    assert (truth.at.tolist(), truth.points.tolist()) == (list(range(6)), [6, 0, 0, 3, 2, 1])
    back = shapes.truth("2", "1")
    assert (back.at.tolist(), back.points.tolist()) == ([6, 0, 0, 3, 2, 1], list(range(6)))
    assert back.source.endswith("backwards")
    assert shapes.truth("2", "2").points.tolist() == list(range(7))
    with pytest.raises(TruthError, match=r"no truth from 10 to 2: there is no 10_2\.map, nor backwards"):
        shapes.truth("10", "2")
    with pytest.raises(ValueError, match="no shape '40'"):
        shapes.truth("1", "40")
    assert list(found(shapes)) == ["40"]
    assert list(found(shapes, "note")) == ["40"]


def test_malformed_and_missing_are_named(set_):
    root, folder, base = set_
    write_lines(folder / "1_2.map", [i + base for i in (6, 0, 0, 3, 2)])
    write_lines(folder / "10_1.map", [base, base, 5 + base, base, 6 + base, base])
    write_lines(folder / "3_1.map", [base] * 6)
    write_mesh(next(path for path in root.iterdir() if path != folder) / "7.off")
    shapes = open_shapes(root)
    malformed, missing = found(shapes, "malformed"), found(shapes, "missing")
    assert set(malformed) == {"1_2", "10_1"}
    assert "1_2.map: 5 lines, but shape 1 has 6 vertices" in malformed["1_2"]
    assert f"10_1.map:5: vertex {6 + base} is out of range: shape 1 has 6" in malformed["10_1"]
    assert set(missing) == {"3", "7"}
    assert "3.off: no such mesh, but 1 maps name it" in missing["3"]
    assert missing["7"] == "no map names shape 7"
    with pytest.raises(TruthError, match=r"1_2\.map: 5 lines"):
        shapes.truth("2", "1")
