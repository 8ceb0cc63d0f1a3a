from dataclasses import dataclass

import torch

from torchqm.learn.faults import pair_names, save_batch


@dataclass(frozen=True)
class Truth:
    """An object, as a batch has them."""

    number: int


def test_a_kept_batch_comes_back_without_pickle_and_without_objects(tmp_path):
    sparse = torch.eye(3).to_sparse_coo()
    side = {"name": ["a", "b"], "verts": torch.rand(2, 3, 3, requires_grad=True), "gradX": sparse, "k": 3}
    batch = {"first": side, "second": side | {"name": ["c", "d"]}, "truth": [Truth(1), Truth(2)]}
    path = save_batch(tmp_path / "new" / "stopped.pt", batch, step=4, hparams={"inputs": ("wks",)})
    kept = torch.load(path, weights_only=True)
    assert kept["pairs"] == pair_names(batch) == ["a -> c", "b -> d"]
    assert kept["step"] == 4
    assert kept["hparams"] == {"inputs": ["wks"]}
    assert set(kept["batch"]) == {"first", "second"}
    assert torch.equal(kept["batch"]["first"]["verts"], side["verts"])
    assert not kept["batch"]["first"]["verts"].requires_grad
    assert torch.equal(kept["batch"]["second"]["gradX"].to_dense(), torch.eye(3))
    assert [file.name for file in path.parent.iterdir()] == ["stopped.pt"]
