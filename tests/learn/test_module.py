from itertools import pairwise

import pytest
import torch
from pytorch_lightning import Callback, Trainer
from torch.utils.data import DataLoader

from torchqm.data import collate
from torchqm.learn import MatchModule, save_net
from torchqm.learn.callbacks import LastEpoch
from torchqm.learn.faults import StepError

SMALL = {"k": 20, "signature": 16, "channels": 12, "width": 24, "odd_pairs": 20, "dropout": 0.2}


class Shuffled(torch.utils.data.Sampler):
    """An order for each epoch, as that of torchqm.data.datamodule, which this floor does not know."""

    def __init__(self):
        self.epoch = 0

    def set_epoch(self, epoch):
        self.epoch = epoch

    def __len__(self):
        return 2

    def __iter__(self):
        return iter([0, 1] if self.epoch % 2 else [1, 0])


class Killed(Callback):
    """Ends the run in the middle of its second epoch."""

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if trainer.global_step == 3:
            raise RuntimeError("killed")


def loaders(pairs):
    single = [
        {side: {k: v.float() if torch.is_tensor(v) and v.is_floating_point() else v for k, v in pair[side].items()}
         for side in ("first", "second")} | {"truth": pair["truth"]}
        for pair in pairs
    ]  # fmt: skip
    return DataLoader(single, sampler=Shuffled(), collate_fn=collate), DataLoader(single, collate_fn=collate)


def trainer(folder, epochs, *callbacks, checkpoints=True, **more):
    kept = [LastEpoch(folder)] if checkpoints else []
    return Trainer(
        accelerator="cpu", max_epochs=epochs, logger=False, callbacks=[*kept, *callbacks], num_sanity_val_steps=0,
        enable_checkpointing=checkpoints, enable_progress_bar=False, enable_model_summary=False, **more,
    )  # fmt: skip


def fit(folder, pairs, epochs, *callbacks, seed=0, ckpt_path=None, checkpoints=True):
    torch.manual_seed(seed + 17)  # whatever was drawn before does not matter
    module = MatchModule("quotient+odd", seed=seed, **SMALL)
    run = trainer(folder, epochs, *callbacks, checkpoints=checkpoints)
    run.fit(module, *loaders(pairs), ckpt_path=ckpt_path, weights_only=None if ckpt_path is None else True)
    return module, run


def same(a, b):
    return all(torch.equal(u, v) for u, v in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


@pytest.fixture(scope="module")
def whole(tmp_path_factory, pairs):
    """An uninterrupted run of three epochs."""
    folder = tmp_path_factory.mktemp("whole")
    return *fit(folder, pairs, 3), folder


def test_a_run_that_is_killed_and_resumed_ends_where_the_uninterrupted_one_does(whole, pairs, tmp_path):
    with pytest.raises(RuntimeError, match="killed"):
        fit(tmp_path, pairs, 3, Killed())
    torch.rand(5)
    resumed, run = fit(tmp_path, pairs, 3, ckpt_path=tmp_path / "last.ckpt")
    assert run.global_step == 6
    assert same(resumed, whole[0])


def test_the_seed_decides_weights_and_course(whole, pairs, tmp_path):
    again, _ = fit(tmp_path, pairs, 3, checkpoints=False)
    assert same(again, whole[0])
    first, other = (MatchModule("quotient+odd", seed=seed, **SMALL) for seed in (0, 1))
    assert not same(first, other)
    assert not same(first, whole[0])


def test_a_checkpoint_holds_the_module_and_nothing_that_needs_pickle(whole):
    module, _, folder = whole
    loaded = MatchModule.load_from_checkpoint(folder / "last.ckpt", weights_only=True)
    assert same(loaded, module)
    assert dict(loaded.hparams) == dict(module.hparams)
    assert loaded.hparams["setup"] == "quotient+odd"


def test_what_is_logged_are_the_losses_and_errors_of_the_network(whole, pairs):
    module, run, _ = whole
    assert {"train_loss", "train_l_bij", "val_loss", "val_l_align", "val_plain_error", "val_flipped_points"} <= set(
        run.callback_metrics
    )
    module.eval()
    each = [(batch, module.net(batch["first"], batch["second"])) for batch in loaders(pairs)[1]]
    wanted = sum(module.net.errors(*pair)["orbit_error"].item() for pair in each) / len(each)
    assert run.callback_metrics["val_orbit_error"].item() == pytest.approx(wanted, rel=1e-4)
    loss = sum(sum(module.net.losses(*pair).values()).item() for pair in each) / len(each)
    assert run.callback_metrics["val_loss"].item() == pytest.approx(loss, rel=1e-4)


def test_a_training_begins_with_given_weights_once_and_needs_their_file_no_more(pairs, tmp_path):
    given = MatchModule("quotient", seed=5, **SMALL)
    path = save_net(given.net, tmp_path / "net.safetensors")
    begun = MatchModule("quotient", "orbit", seed=0, start=str(path), **SMALL)
    assert not same(begun.net, given.net)  # a config that is only looked at reads nothing
    trainer(tmp_path, 0, checkpoints=False).fit(begun, *loaders(pairs))
    assert same(begun.net, given.net)
    trainer(tmp_path, 1).fit(begun, *loaders(pairs))  # goes on from what it is
    fresh = MatchModule("quotient", "orbit", seed=0, start=str(path), **SMALL)
    trainer(tmp_path / "fresh", 1, checkpoints=False).fit(fresh, *loaders(pairs))
    assert same(fresh, begun)
    path.unlink()
    resumed = MatchModule("quotient", "orbit", seed=0, start=str(path), **SMALL)
    run = trainer(tmp_path, 2)
    run.fit(resumed, *loaders(pairs), ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    assert run.global_step == 4
    loaded = MatchModule.load_from_checkpoint(tmp_path / "last.ckpt", weights_only=True)
    assert same(loaded, resumed)
    trainer(tmp_path, 0, checkpoints=False).fit(loaded, *loaders(pairs))
    assert same(loaded, resumed)
    with pytest.raises(ValueError, match=r"start: .*net.safetensors: no such file"):
        trainer(tmp_path, 1, checkpoints=False).fit(MatchModule("quotient", start=str(path), **SMALL), *loaders(pairs))


def without_truth(pair):
    none = torch.zeros(0, dtype=torch.long)
    return pair | {side: pair[side] | {"corr": none} for side in ("first", "second")}


def test_errors_are_means_over_the_pairs_with_a_truth_and_losses_over_all(pairs, tmp_path):
    given = [without_truth(pairs[0]), pairs[1], pairs[0]]
    data = DataLoader(loaders(given)[1].dataset, batch_size=2, collate_fn=collate)
    module, run = MatchModule("quotient", "orbit", **SMALL), trainer(tmp_path, 1, checkpoints=False)
    run.validate(module, data, verbose=False)
    module.eval()
    each = [(batch, module.net(batch["first"], batch["second"])) for batch in loaders(given)[1]]
    error = sum(module.net.errors(*pair)["orbit_error"].item() for pair in each[1:]) / 2
    assert run.callback_metrics["val_orbit_error"].item() == pytest.approx(error, rel=1e-5)
    for name in ("l_truth", "l_bij"):
        terms = [module.net.losses(*pair)[name].item() for pair in each]
        assert run.callback_metrics[f"val_{name}"].item() == pytest.approx(sum(terms) / 3, rel=1e-5)
    assert module.net.losses(*each[0])["l_truth"] == 0.0
    run.validate(module, loaders(given[:1])[1], verbose=False)
    assert "val_loss" in run.callback_metrics
    assert "val_orbit_error" not in run.callback_metrics


def test_a_supervision_without_any_truth_stops_after_the_first_epoch(pairs, tmp_path):
    none, message = [without_truth(pair) for pair in pairs], "supervision: 'orbit' given, but no training pair has a"
    run = trainer(tmp_path, 3, checkpoints=False)
    with pytest.raises(StepError, match=message):
        run.fit(MatchModule("quotient", "orbit", **SMALL), loaders(none)[0])
    assert run.current_epoch == 0
    run = trainer(tmp_path, 2, checkpoints=False)
    run.fit(MatchModule("quotient", "orbit", **SMALL), loaders([none[0], pairs[1]])[0])
    assert run.global_step == 4


def test_a_loss_that_is_not_finite_stops_the_run_and_names_the_pairs(pairs, tmp_path):
    module = MatchModule("quotient", **SMALL)
    module.net.options.__dict__["w_align"] = float("inf")
    with pytest.raises(FloatingPointError, match=r"the loss is inf .*l_align inf.*quadruped-0-pose0 -> quadruped-0-po"):
        trainer(tmp_path, 1, checkpoints=False).fit(module, *loaders(pairs))


class Losses(Callback):
    """The loss of each step."""

    def __init__(self):
        self.values = []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.values.append(outputs["loss"].item())


def test_mixed_precision_trains_as_the_whole_one_does(pairs, tmp_path):
    courses = {}
    for precision in ("32-true", "bf16-mixed"):
        module, course = MatchModule("quotient", **(SMALL | {"dropout": 0.0})), Losses()
        trainer(tmp_path, 6, course, checkpoints=False, precision=precision).fit(module, *loaders(pairs))
        assert all(p.dtype == torch.float32 and p.isfinite().all() for p in module.parameters())
        courses[precision] = [sum(course.values[i : i + 2]) for i in range(0, 12, 2)]
    whole, mixed = courses.values()
    assert whole != mixed
    assert all(after < before for before, after in pairwise(mixed))
    assert abs(mixed[-1] - whole[-1]) < 0.1 * (whole[0] - whole[-1])  # what it learns, it learns in both


def test_a_gradient_that_is_not_finite_stops_before_the_weights_are_spoiled(pairs, tmp_path):
    class Spoiled(Callback):
        def on_after_backward(self, trainer, pl_module):
            if trainer.global_step == 1:
                next(pl_module.parameters()).grad.fill_(float("inf"))

    module = MatchModule("quotient", **SMALL)
    with pytest.raises(
        StepError, match=r"the gradient of net.features.net.layers.0.weight is not finite at the pairs b"
    ):
        trainer(tmp_path, 1, Spoiled(), checkpoints=False).fit(module, *loaders(pairs))
    assert all(p.isfinite().all() for p in module.parameters())


def test_numbers_that_a_layer_refuses_are_told_with_the_pairs(pairs, tmp_path):
    module = MatchModule("quotient", **SMALL)
    with torch.no_grad():
        next(module.parameters()).fill_(float("nan"))
    with pytest.raises(
        StepError, match=r"feat_x: .* are NaN .* at the pairs \w+-0-pose0 -> \w+-0-pose1, in step 0 of epoch 0$"
    ):
        trainer(tmp_path, 1, checkpoints=False).fit(module, *loaders(pairs))


def test_options_of_adam_that_are_changed_hold_after_a_checkpoint_and_others_stay(whole, pairs, tmp_path):
    module = MatchModule("quotient+odd", **{**SMALL, "lr": 0.5})
    run = trainer(tmp_path, 3)  # all epochs are done
    run.fit(module, *loaders(pairs), ckpt_path=whole[2] / "last.ckpt", weights_only=True)
    (group,) = run.optimizers[0].param_groups
    assert (group["lr"], group["weight_decay"]) == (0.5, 0.0)
    content = torch.load(whole[2] / "last.ckpt", weights_only=True)
    content["optimizer_states"][0]["param_groups"][0]["lr"] = 0.25  # by a callback, in the course of the run
    torch.save(content, tmp_path / "warm.ckpt")
    run = trainer(tmp_path, 3)
    run.fit(MatchModule("quotient+odd", **SMALL), *loaders(pairs), ckpt_path=tmp_path / "warm.ckpt", weights_only=True)
    assert run.optimizers[0].param_groups[0]["lr"] == 0.25
