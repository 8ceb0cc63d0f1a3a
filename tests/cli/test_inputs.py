import pytest
from references import shapes

from torchqm.cli.console import UserError
from torchqm.cli.inputs import fit_parameters, read_mesh
from torchqm.geometry import save_mesh
from torchqm.matching import MatchParameters


@pytest.mark.parametrize("scale", [1e-100, 1e-50, 1.0, 1e50, 1e100])
def test_vertices_are_counted_alike_at_every_scale(scale):
    mesh = shapes.blob(1).mesh
    mesh = mesh.moved(mesh.verts * scale)
    fitted, notes = fit_parameters(MatchParameters(), [mesh], k_max_given=False)
    assert fitted == MatchParameters()
    assert notes == []
    with pytest.raises(UserError, match=r"642 vertices are fewer than the 700 eigenfunctions .*--k-max 700"):
        fit_parameters(MatchParameters(k_max=700), [mesh], k_max_given=True)


@pytest.mark.parametrize(("scale", "word"), [(1e-100, "small"), (1e100, "large"), (1e307, "large")])
def test_an_extent_beyond_the_limits_is_the_user_s_to_mend(tmp_path, scale, word):
    mesh = shapes.blob(1).mesh
    save_mesh(mesh.moved(mesh.verts * scale), tmp_path / "x.off")
    with pytest.raises(UserError, match=rf"x\.off: the coordinates are too {word}: .*rescale"):
        read_mesh(tmp_path / "x.off", {})
