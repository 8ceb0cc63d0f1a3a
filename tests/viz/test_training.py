import pytest
from matplotlib.image import imread

from torchqm.viz.training import read_metrics, training_curves

TABLE = (
    "epoch,step,train_loss,val_loss,val_orbit_error,lr\n0,1,,3.5,0.2,0.1\n0,1,4.0,,,\n1,3,,3.0,0.1,0.1\n1,3,2.0,,,\n"
)


def test_columns_are_read_by_epoch_without_their_empty_cells(tmp_path):
    (tmp_path / "metrics.csv").write_text(TABLE)
    found = read_metrics(tmp_path / "metrics.csv")
    assert found["train_loss"] == [(0.0, 4.0), (1.0, 2.0)]
    assert found["val_orbit_error"] == [(0.0, 0.2), (1.0, 0.1)]
    assert "step" not in found
    (tmp_path / "metrics.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"metrics.csv: no table of metrics, a column 'epoch' is missing"):
        read_metrics(tmp_path / "metrics.csv")


def test_there_is_a_panel_for_what_was_logged_only(tmp_path):
    (tmp_path / "metrics.csv").write_text(TABLE)
    assert training_curves(tmp_path / "metrics.csv", tmp_path / "two.png") == tmp_path / "two.png"
    assert imread(tmp_path / "two.png").shape[:2] == (600, 1440)  # loss and errors, no flip rate
    (tmp_path / "metrics.csv").write_text("epoch,step,lr\n0,1,0.1\n")
    assert training_curves(tmp_path / "metrics.csv", tmp_path / "none.png") is None
    assert not (tmp_path / "none.png").exists()


def test_a_loss_that_is_no_number_is_drawn_all_the_same(tmp_path):
    (tmp_path / "metrics.csv").write_text("epoch,step,train_loss\n0,1,2.0\n1,3,nan\n")
    assert training_curves(tmp_path / "metrics.csv", tmp_path / "a.png").is_file()
