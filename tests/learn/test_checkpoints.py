import pickle
import warnings

import pytest
import torch

from torchqm.learn import load_net
from torchqm.learn.checkpoints import find_weights
from torchqm.learn.files import digest


def test_a_run_folder_gives_its_best_checkpoint(run):
    folder, module = run
    with pytest.warns(
        UserWarning, match=r"best-epoch=10\.ckpt: taken for its name: no checkpoint in .* which of the 3 "
    ):
        assert find_weights(folder).name == "best-epoch=10.ckpt"
    for path in (folder, folder / "checkpoints", folder / "checkpoints" / "last.ckpt"):
        net = load_net(path)
        assert digest(net) == digest(module.net)
        assert net.options.inputs == ("wks", "xyz")


def test_of_several_good_checkpoints_the_best(run, tmp_path):
    """Not the one of the highest epoch: the last checkpoint remembers which, wherever the folder is now."""
    folder = tmp_path / "moved" / "checkpoints"
    folder.mkdir(parents=True)
    for path in (run[0] / "checkpoints").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    content = torch.load(folder / "last.ckpt", weights_only=True)
    content["callbacks"] = {"Other": {}, "Best": {"best_model_path": "/elsewhere/checkpoints/best-epoch=9.ckpt"}}
    torch.save(content, folder / "last.ckpt")
    assert find_weights(tmp_path / "moved") == folder / "best-epoch=9.ckpt"
    (folder / "best-epoch=9.ckpt").unlink()
    assert find_weights(tmp_path / "moved") == folder / "best-epoch=10.ckpt"


def test_without_a_last_one_the_latest_says_which_is_the_best(run, tmp_path):
    """Whatever they are called: the options of a run may say so."""
    content = torch.load(run[0] / "checkpoints" / "last.ckpt", weights_only=True)
    for step, name, best in ((2, "c-loss=1", "c-loss=1"), (8, "b-loss=3", "a-loss=0"), (4, "a-loss=0", "a-loss=0")):
        state = {"best_model_path": f"/elsewhere/{best}.ckpt"}
        torch.save(content | {"global_step": step, "callbacks": {"Best": state}}, tmp_path / f"{name}.ckpt")
    (tmp_path / "d.ckpt").write_bytes(b"damaged")  # the last by name
    with warnings.catch_warnings(action="error"):
        assert find_weights(tmp_path) == tmp_path / "a-loss=0.ckpt"
    (tmp_path / "a-loss=0.ckpt").unlink()
    assert find_weights(tmp_path) == tmp_path / "c-loss=1.ckpt"
    (tmp_path / "c-loss=1.ckpt").unlink()
    with pytest.warns(UserWarning, match=r"d\.ckpt: taken for its name: .* which of the 2 scored best"):
        assert find_weights(tmp_path) == tmp_path / "d.ckpt"
    (tmp_path / "d.ckpt").unlink()
    with warnings.catch_warnings(action="error"):
        assert find_weights(tmp_path) == tmp_path / "b-loss=3.ckpt"  # there is no other


def test_the_largest_step_says_which_is_the_best_not_the_last_one(run, tmp_path):
    """A run that was killed after it kept a better one, before it wrote ``last``."""
    content = torch.load(run[0] / "checkpoints" / "last.ckpt", weights_only=True)
    for step, name, best in (
        (5, "last", "best-epoch=1"),
        (5, "best-epoch=1", "best-epoch=1"),
        (9, "z", "best-epoch=1"),
    ):
        state = {"best_model_path": f"/elsewhere/{best}.ckpt", "best_model_score": 1.0}
        torch.save(content | {"global_step": step, "callbacks": {"Best": state}}, tmp_path / f"{name}.ckpt")
    state = {"best_model_path": "/elsewhere/best-epoch=7.ckpt", "best_model_score": 0.5}
    with warnings.catch_warnings(action="error"):
        assert find_weights(tmp_path) == tmp_path / "best-epoch=1.ckpt"
        torch.save(content | {"global_step": 50, "callbacks": {"Best": state}}, tmp_path / "best-epoch=7.ckpt")
        assert find_weights(tmp_path) == tmp_path / "best-epoch=7.ckpt"
        (tmp_path / "z.ckpt").unlink()
        state["best_model_path"] = "/elsewhere/best-epoch=1.ckpt"  # of one step, what is written last
        torch.save(content | {"global_step": 50, "callbacks": {"Best": state}}, tmp_path / "last.ckpt")
        assert find_weights(tmp_path) == tmp_path / "best-epoch=1.ckpt"


def test_callbacks_that_disagree_about_the_best_are_told_of(run, tmp_path):
    content = torch.load(run[0] / "checkpoints" / "last.ckpt", weights_only=True)
    for name in "abc":
        torch.save(content | {"callbacks": {}}, tmp_path / f"{name}.ckpt")

    def find(**best):
        """With states in this order: the name of what each has for the best, and its score."""
        states = {key: {"best_model_path": f"/x/{name}.ckpt", "best_model_score": v} for key, (name, v) in best.items()}
        torch.save(content | {"callbacks": states}, tmp_path / "last.ckpt")
        return find_weights(tmp_path).name

    with pytest.warns(UserWarning, match=r"b\.ckpt: taken as the best; the callbacks of last\.ckpt disagree, ") as w:
        assert find(Another=("a", 1.0), BestCheckpoint=("b", 2.0), Other=("b", 1.0), Third=("c", 0.0)) == "b.ckpt"
    assert str(w[0].message).endswith("others have a.ckpt and c.ckpt")
    with pytest.warns(UserWarning, match=r"disagree"):
        assert find(Z=("a", 1.0), Y=("c", 1.0)) == "c.ckpt"  # not by their order in the file
    with warnings.catch_warnings(action="error"):
        assert find(Every=("a", None), ModelCheckpoint=("b", 2.0)) == "b.ckpt"  # kept by no score
        assert find(Best=("b", 1.0), Same=("b", 3.0), Gone=("d", 0.0)) == "b.ckpt"


def test_bytes_that_changed_in_a_checkpoint_are_noticed(run, tmp_path):
    """Also where the pickle is whole and torch reads it: in the numbers of a weight."""
    content = bytearray((run[0] / "checkpoints" / "last.ckpt").read_bytes())
    weights = max(run[1].net.state_dict().values(), key=torch.numel).numpy().tobytes()
    at = bytes(content).index(weights)
    content[at : at + 4] = bytes(255 - byte for byte in content[at : at + 4])
    path = tmp_path / "flipped.ckpt"
    path.write_bytes(content)
    torch.load(path, weights_only=True)
    with pytest.raises(ValueError, match=r"flipped\.ckpt: damaged, .* is not what was written"):
        load_net(path)


class Evil:
    def __reduce__(self):
        return print, ("executed",)


def test_nothing_in_a_checkpoint_is_executed(tmp_path, capsys):
    for name, save in (("zip.ckpt", torch.save), ("raw.ckpt", lambda v, p: p.write_bytes(pickle.dumps(v)))):
        save({"state_dict": {}, "hyper_parameters": {"k": Evil()}}, tmp_path / name)
        with pytest.raises(ValueError, match=rf"{name}: damaged, or holds more than weights"):
            load_net(tmp_path / name)
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "content", [{"model": torch.ones(1)}, [1], {"state_dict": {}, "hyper_parameters": {"hidden": 3}}]
)
def test_checkpoints_of_others_are_refused(content, tmp_path):
    torch.save(content, tmp_path / "foreign.ckpt")
    with pytest.raises(ValueError, match=r"foreign\.ckpt: no checkpoint of torchqm\.learn\.MatchModule"):
        load_net(tmp_path / "foreign.ckpt")
