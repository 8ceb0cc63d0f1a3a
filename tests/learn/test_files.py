import json
import re

import pytest
import torch
from safetensors.torch import load_file, save_file

from torchqm.data import collate
from torchqm.learn import MatchNet, NetOptions, load_net, save_net
from torchqm.learn.files import _digest, digest

SMALL = {"k": 20, "signature": 16, "channels": 12, "width": 24, "odd_pairs": 20}


def net_of(seed=0, **more):
    torch.manual_seed(seed)
    return MatchNet(NetOptions(**(SMALL | more)))


@pytest.mark.parametrize("more", [{}, {"network": "diffusion", "inputs": ("hks", "xyz")}, {"network": "none"}])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_saved_network_computes_the_same(more, dtype, tmp_path, pairs):
    net = net_of(**more).to(dtype).eval()
    for parameter in net.parameters():
        parameter.data += 1e-12  # more than float32 holds
    again = load_net(save_net(net, tmp_path / "net.safetensors"))
    assert again.options == net.options
    assert not again.training
    item = collate([{k: v.to(dtype) if torch.is_tensor(v) and v.is_floating_point() else v
                     for k, v in pairs[0]["first"].items()}])  # fmt: skip
    assert torch.equal(again.describe(item), net.describe(item))
    assert again.describe(item).dtype == dtype


def test_equal_networks_are_equal_files_and_have_one_digest(tmp_path):
    files = [save_net(net_of(), tmp_path / f"{i}.safetensors", {"b": 1, "a": [2]}).read_bytes() for i in range(2)]
    assert files[0] == files[1]
    other = [net_of(1), net_of(tau=0.08), net_of().double(), net_of().bfloat16()]
    assert len({digest(net) for net in (net_of(), net_of(), *other)}) == 5


def damaged(path, content):
    path.write_bytes(content)
    return path


def test_damaged_files_are_named(run, tmp_path):
    good = save_net(net_of(), tmp_path / "good.safetensors").read_bytes()
    ckpt = (run[0] / "checkpoints" / "last.ckpt").read_bytes()
    bad = {
        "cut.safetensors": good[:-100],
        "empty.safetensors": b"",
        "noise.safetensors": b"\xff" * 500,
        "cut.ckpt": ckpt[: len(ckpt) // 2],
        "empty.ckpt": b"",
        "noise.ckpt": b"\x01" * 500,
    }
    for name, content in bad.items():
        with pytest.raises(ValueError, match=rf"{name}: damaged"):
            load_net(damaged(tmp_path / name, content))


def test_a_changed_weight_is_noticed(tmp_path):
    content = bytearray(save_net(net_of(), tmp_path / "net.safetensors").read_bytes())
    content[-40] ^= 1
    with pytest.raises(ValueError, match=r"flipped\.safetensors: damaged: its weights are not those"):
        load_net(damaged(tmp_path / "flipped.safetensors", bytes(content)))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_no_numbers_are_refused(value, run, tmp_path):
    net = net_of()
    name, parameter = next(iter(net.named_parameters()))
    parameter.data.view(-1)[0] = value
    with pytest.raises(ValueError, match=rf"net\.safetensors: weights that are NaN or infinite: {re.escape(name)}"):
        load_net(save_net(net, tmp_path / "net.safetensors"))
    content = torch.load(run[0] / "checkpoints" / "last.ckpt", weights_only=True)
    content["state_dict"][f"net.{name}"].view(-1)[0] = value
    torch.save(content, tmp_path / "net.ckpt")
    with pytest.raises(ValueError, match=rf"net\.ckpt: weights that are NaN or infinite: net\.{re.escape(name)}"):
        load_net(tmp_path / "net.ckpt")


def test_a_file_that_knows_fewer_options_is_read_with_their_defaults(tmp_path):
    """As one of an earlier version would be; its weights are still checked."""
    path, net = tmp_path / "early.safetensors", net_of()
    options = {**SMALL, "setup": "quotient+odd"}
    head = {"format": 1, "options": options, "digest": _digest(options, net.state_dict())}
    save_file(net.state_dict(), path, {"torchqm": json.dumps(head)})
    assert load_net(path).options == net.options


def test_weights_of_another_architecture_are_listed(tmp_path, run):
    path = save_net(net_of(), tmp_path / "net.safetensors")
    tensors = load_file(path)
    tensors["more"] = tensors.pop("features.net.layers.0.bias")
    tensors["odd.pairs"] = tensors["odd.pairs"][:, :5].contiguous()
    head = {"format": 1, "options": {"setup": "quotient", **SMALL}}
    save_file(tensors, path, {"torchqm": json.dumps(head)})
    wanted = r"net\.safetensors: weights of another architecture.*layers\.0\.bias is missing; more is not of it; "
    with pytest.raises(ValueError, match=wanted + r"odd\.pairs is \(2, 5\) instead of \(2, 20\)$"):
        load_net(path)
    content = torch.load(run[0] / "checkpoints" / "last.ckpt", weights_only=True)
    content["hyper_parameters"]["width"] = 25
    torch.save(content, tmp_path / "wide.ckpt")
    with pytest.raises(ValueError, match=r"wide\.ckpt: .*layers\.0\.weight is \(24, 19\) instead of \(25, 19\)"):
        load_net(tmp_path / "wide.ckpt")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (None, "no network of torchqm"),
        ("[1]", "no network of torchqm"),
        ("{", "no network of torchqm"),
        (json.dumps({"format": 2, "options": {}}), "of format 2; this version of torchqm reads 1"),
        (json.dumps({"format": 1, "options": {"depth": 3}}), "does not know: depth"),
        (json.dumps({"format": 1, "options": {"network": "gnn"}}), "make no network: network: 'gnn' given"),
        (json.dumps({"format": 1, "options": {"k": "many"}}), "make no network"),
    ],
)
def test_safetensors_of_others_are_refused(head, message, tmp_path):
    path = tmp_path / "foreign.safetensors"
    save_file({"weight": torch.ones(2)}, path, None if head is None else {"torchqm": head})
    with pytest.raises(ValueError, match=rf"foreign\.safetensors: .*{message}"):
        load_net(path)


def test_paths_that_lead_to_no_network_are_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere: no such file or run folder; 'builtin' names"):
        load_net(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="no checkpoint in"):
        load_net(tmp_path)
    (tmp_path / "net.pt").write_bytes(b"")
    with pytest.raises(ValueError, match=r"net\.pt: a trained network is a \.safetensors or a \.ckpt file"):
        load_net(tmp_path / "net.pt")
    with pytest.raises(ValueError, match=r"net\.pt: .* ends with \.safetensors"):
        save_net(net_of(), tmp_path / "net.pt")
