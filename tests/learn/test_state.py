import pickle
import re

import pytest
import torch
from pytorch_lightning import Trainer

from torchqm.learn import MatchModule, save_net
from torchqm.learn.state import check_state

SMALL = {"k": 8, "channels": 6, "width": 8, "signature": 8, "setup": "quotient"}


class Evil:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def check(path, training=True, **options):
    module = MatchModule(**{**SMALL, **options})
    return check_state(path, module.hparams, module.state_dict(), training)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A checkpoint, and files that are none that can be used."""
    folder = tmp_path_factory.mktemp("checkpoints")
    module = MatchModule(**SMALL)
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.strategy.connect(module)
    trainer.save_checkpoint(folder / "weights.ckpt", weights_only=True)
    loop = {"epoch_progress": {"total": {"processed": 3}}, "epoch_loop.state_dict": {"_batches_that_stepped": 12}}
    content = torch.load(folder / "weights.ckpt", weights_only=True)
    whole = content | {"optimizer_states": [], "loops": {"fit_loop": loop}}
    torch.save(whole, folder / "good.ckpt")
    torch.save(whole | {"loops": {}}, folder / "other.ckpt")
    torch.save(whole | {"hyper_parameters": {"depth": 3}}, folder / "foreign.ckpt")
    torch.save({key: whole[key] for key in whole if "version" not in key}, folder / "bare.ckpt")
    torch.save({"a": 1}, folder / "dict.ckpt")
    torch.save(whole | {"more": Evil(folder / "evil")}, folder / "evil.ckpt")
    (folder / "raw.ckpt").write_bytes(pickle.dumps(Evil(folder / "evil")))
    (folder / "cut.ckpt").write_bytes((folder / "good.ckpt").read_bytes()[:900])
    (folder / "empty.ckpt").touch()
    save_net(module.net, folder / "net.safetensors")
    return folder


def test_a_checkpoint_says_how_far_its_training_has_come(folder):
    found = check(folder / "good.ckpt")
    assert (found.path, found.epochs, found.steps) == (folder / "good.ckpt", 3, 12)
    # What is solved with the features, and how they are trained, may change.
    assert check(folder / "good.ckpt", setup="quotient+odd", lr=0.5, w_bij=0.0, rotations=True).steps == 12


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.ckpt", r"none\.ckpt: no such file"),
        (".", "is a folder; a checkpoint is a file, such as RUN/checkpoints/last.ckpt"),
        ("net.safetensors", r"net\.safetensors: weights of 'torchqm export'"),
        ("weights.ckpt", r"weights\.ckpt: weights without the state of a training \(optimizer_states.* missing\)"),
        ("other.ckpt", r"other\.ckpt: its state of a training is not that of this version of Lightning"),
        ("foreign.ckpt", r"foreign\.ckpt: no checkpoint of torchqm\.learn\.MatchModule: its hyperparameters"),
        ("bare.ckpt", r"bare\.ckpt: no checkpoint of Lightning \(pytorch-lightning_version missing\)"),
        ("dict.ckpt", r"dict\.ckpt: no checkpoint of torchqm\.learn\.MatchModule"),
        ("cut.ckpt", r"cut\.ckpt: damaged, cut short or no checkpoint"),
        ("empty.ckpt", r"empty\.ckpt: damaged"),
        ("evil.ckpt", r"evil\.ckpt: damaged, or holds more than weights \(io\.open\) and is not read$"),
        ("raw.ckpt", r"raw\.ckpt: damaged, or holds more than weights( \(io\.open\))? and is not read$"),
    ],
)
def test_what_cannot_be_used_is_named_and_nothing_is_executed(name, message, folder):
    with pytest.raises(ValueError, match=message):
        check(folder / name)
    assert not (folder / "evil").exists()


def test_a_test_needs_no_state_of_a_training(folder):
    check(folder / "weights.ckpt", training=False)
    with pytest.raises(ValueError, match=r"other\.ckpt: its state of a training is not that of this version"):
        check(folder / "other.ckpt", training=False)


def test_a_url_is_not_fetched():
    with pytest.raises(ValueError, match=r"https://x\.org/a\.ckpt: a URL; a checkpoint is read from a file on this"):
        check("https://x.org/a.ckpt")


def test_options_of_another_architecture_are_named(folder):
    with pytest.raises(ValueError, match=r"good\.ckpt: of another architecture: model\.channels is 6 in it and 7 here, "
                       r"model\.blocks is 2 in it and 3 here; the configuration"):  # fmt: skip
        check(folder / "good.ckpt", channels=7, blocks=3)
    with pytest.raises(ValueError, match=r"model\.inputs is \['wks'\] in it and \['hks'\] here"):  # of the same shape
        check(folder / "good.ckpt", training=False, inputs=["hks"])
    with pytest.raises(ValueError, match=r"model\.network is mlp in it and diffusion here, model\.rotations is False"):
        check(folder / "good.ckpt", network="diffusion", rotations=True)


def test_shapes_that_are_others_are_named(folder, tmp_path):
    content = torch.load(folder / "good.ckpt", weights_only=True)
    name = next(iter(content["state_dict"]))
    shape = tuple(content["state_dict"][name].shape)
    content["state_dict"][name] = torch.zeros(3, 3)
    torch.save(content, tmp_path / "wide.ckpt")
    text = f"wide.ckpt: weights of another architecture: {name} is (3, 3) instead of {shape}"
    with pytest.raises(ValueError, match=f"{re.escape(text)}$"):
        check(tmp_path / "wide.ckpt")
