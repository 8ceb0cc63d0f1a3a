import json
from unittest.mock import Mock

import torch
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.loggers import Logger

from torchqm.learn.callbacks import BestCheckpoint, LastEpoch, Versions


def state(folder):
    best = f"{folder}/best-epoch=3.ckpt"
    paths = {"best_model_path": best, "kth_best_model_path": best, "last_model_path": ""}
    score = torch.tensor(0.25)
    return paths | {"monitor": "a", "dirpath": folder, "best_model_score": score, "best_k_models": {best: score},
                    "current_score": score, "kth_value": score}  # fmt: skip


def test_the_best_checkpoint_is_remembered_where_its_folder_is_now(tmp_path):
    callback = BestCheckpoint(tmp_path, monitor="a")
    callback.return_to_folder(goes_on=True)
    callback.load_state_dict(state("/elsewhere"))
    here = str(tmp_path / "best-epoch=3.ckpt")
    assert (callback.best_model_path, callback.kth_best_model_path, callback.last_model_path) == (here, here, "")
    assert callback.best_k_models == {here: torch.tensor(0.25)}
    assert callback.best_model_score == callback.kth_value == 0.25


def test_a_run_of_its_own_has_no_best_checkpoint_yet(tmp_path):
    for folder in ("/elsewhere", str(tmp_path)):
        callback = BestCheckpoint(tmp_path, monitor="a")
        callback.load_state_dict(state(folder))
        assert (callback.best_model_path, callback.best_model_score, callback.best_k_models) == ("", None, {})


def test_the_last_epoch_gets_its_name_when_all_loggers_have_written(tmp_path):
    saved = []
    logger = Mock(spec=Logger)
    logger.save = lambda: saved.append((tmp_path / "checkpoints" / "last.ckpt").exists())
    trainer = Mock(spec=Trainer, loggers=[logger], log_dir=str(tmp_path), is_global_zero=True)
    trainer.save_checkpoint = lambda path, weights_only: (path.parent.mkdir(), path.write_text("state"))
    module = LightningModule()
    callback = LastEpoch()
    callback.setup(trainer, module, "fit")
    callback.on_train_epoch_end(trainer, module)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["last.ckpt.part"]
    callback.on_train_epoch_start(trainer, module)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["last.ckpt"]
    callback.on_train_end(trainer, module)  # nothing is waiting
    assert saved == [False, True]


def test_versions_of_before_are_kept(tmp_path):
    trainer, module = Mock(spec=Trainer, log_dir=str(tmp_path), is_global_zero=True), LightningModule()
    path = tmp_path / "versions.json"
    path.write_text('{"torchqm": "0"}')
    for _ in range(2):
        Versions().setup(trainer, module, "fit")
    assert {file.name for file in tmp_path.iterdir()} == {"versions.json", "versions-1.json"}
    assert json.loads((tmp_path / "versions-1.json").read_text()) == {"torchqm": "0"}
    assert json.loads(path.read_text())["torch"] == torch.__version__
