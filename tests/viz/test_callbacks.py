from unittest.mock import MagicMock

import pytest
import torch
from pytorch_lightning import LightningModule, Trainer

from torchqm.data import ItemOptions, PairDataset, collate, open_shapes
from torchqm.learn import MatchNet, NetOptions
from torchqm.viz import callbacks
from torchqm.viz.callbacks import PairPictures, draw_pair

ROOT = "synthetic:kinds=ellipsoid;poses=2;triangulation=shared;verts="


@pytest.fixture(scope="module")
def batch():
    """Two pairs whose numbers of vertices differ, so that one is padded."""
    options = ItemOptions(keys=("mass", "basis", "group", "corr"), k=12, dtype=torch.float32)
    found = collate([
        PairDataset(open_shapes(f"{ROOT}{verts}"), "within-class+unordered", options=options)[0] for verts in (500, 600)
    ])  # fmt: skip
    assert not found["first"]["verts_mask"].all()
    return found


@pytest.mark.parametrize("number", [0, 1])
def test_what_is_drawn_is_the_map_between_the_shapes_without_padding(batch, number, tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        callbacks, "match_figure", lambda *given, **named: drawn.update(given=given, **named) or given[4]
    )
    torch.manual_seed(0)
    net = MatchNet(NetOptions("functional_map", k=12, signature=8, channels=6, width=8))
    draw_pair(net, batch, tmp_path / "a.png", number)
    source, target, maps, labels, path = drawn["given"]
    x, y = batch["first"], batch["second"]
    assert (source.name, target.name) == (x["name"][number], y["name"][number])
    assert source.n_verts == int(x["verts_mask"][number].sum())
    assert source.faces.max() < source.n_verts
    assert len(target.faces) == int(y["faces_mask"][number].sum())
    with torch.no_grad():
        matched = net(x, y)
        wanted = matched.maps.points(y["verts_mask"])[number, : source.n_verts]
        error = net.errors(batch, matched)["orbit_error"][number].item()
    assert (maps[0] == wanted).double().mean() > 0.99  # the rest are ties
    assert maps.max() < target.n_verts
    assert labels == ["learned"]
    assert f"orbit error {error:.3f}" in drawn["title"]
    assert path == tmp_path / "a.png"


def test_pictures_are_drawn_when_it_is_time(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(callbacks, "draw_pair", lambda net, batch, path: drawn.append(path) or path)
    batch = {"first": {"name": ["a/x y"]}, "second": {"name": ["b"]}}
    module = MagicMock(spec=LightningModule, net=None)

    def epochs(every, **given):
        drawn.clear()
        callback = PairPictures(every)
        given = {"sanity_checking": False, "is_global_zero": True, "loggers": [1], "log_dir": str(tmp_path)} | given
        for epoch in range(5):
            trainer = MagicMock(spec=Trainer, current_epoch=epoch, max_epochs=5, **given)
            callback.setup(trainer, module, "fit")
            for number in range(2):
                callback.on_validation_batch_end(trainer, module, None, batch, number)
        return [path.name for path in drawn]

    assert epochs(2) == [f"epoch-{epoch:04d}-a_x_y-to-b.png" for epoch in (2, 4, 5)]
    assert drawn[0].parent == tmp_path / "pictures"
    assert (
        epochs(0) == epochs(1, sanity_checking=True) == epochs(1, is_global_zero=False) == epochs(1, loggers=[]) == []
    )
    with pytest.raises(ValueError, match="every: -1 given"):
        PairPictures(-1)
