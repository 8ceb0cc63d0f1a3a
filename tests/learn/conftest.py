import pytest

ROOT = "synthetic:kinds=biped,quadruped;poses=2;verts=500;triangulation=shared"


@pytest.fixture(scope="session")
def pairs():
    """A pair of bipeds and a pair of quadrupeds; their numbers of vertices differ, their symmetries are exact."""
    import torch

    from torchqm.data import ItemOptions, PairDataset, open_shapes

    options = ItemOptions(keys=("mass", "basis", "group", "gradients", "corr"), k=20, dtype=torch.float64)
    data = PairDataset(open_shapes(ROOT), "within-class+unordered", options=options)
    return [data[0], data[1]]


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run folder as Lightning leaves it, without any training."""
    from pytorch_lightning import Trainer

    from torchqm.learn import MatchModule

    folder = tmp_path_factory.mktemp("run")
    small = {"k": 20, "signature": 16, "channels": 12, "width": 24, "odd_pairs": 20}
    module = MatchModule("quotient+odd", seed=3, inputs=("wks", "xyz"), **small)
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)
    trainer.strategy.connect(module)
    for name in ("best-epoch=9", "best-epoch=10", "last"):
        (folder / "checkpoints").mkdir(exist_ok=True)
        trainer.save_checkpoint(folder / "checkpoints" / f"{name}.ckpt")
    return folder, module
