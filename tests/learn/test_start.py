from dataclasses import replace

import pytest
import torch

from torchqm.learn import MatchNet, NetOptions, save_net
from torchqm.learn.start import start_from

OPTIONS = NetOptions(k=20, signature=16, channels=12, width=24, odd_pairs=20)


@pytest.fixture
def trained(tmp_path):
    torch.manual_seed(3)
    net = MatchNet(OPTIONS)
    return net, save_net(net, tmp_path / "net.safetensors")


def test_the_weights_are_those_of_the_file_whatever_is_trained_on(trained):
    torch.manual_seed(4)
    options = replace(OPTIONS, setup="quotient", supervision="orbit", w_align=0.0, tau=0.1, dropout=0.5)
    net = MatchNet(options)
    start_from(net, trained[1])
    weights = zip(net.state_dict().values(), trained[0].state_dict().values(), strict=True)
    assert all(torch.equal(here, there) for here, there in weights)
    assert net.options == options
    assert net.training


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 32}, "width is 32 here and 24 there"),
        ({"network": "diffusion"}, "network is diffusion here and mlp there"),
        ({"inputs": ("hks",)}, r"inputs is \['hks'\] here and \['wks'\] there"),  # of equal size: no shape tells
        ({"k": 30, "channels": 8}, "k is 30 here and 20 there, channels is 8 here and 12 there"),
    ],
)
def test_another_architecture_is_named_and_nothing_is_changed(trained, change, message):
    net = MatchNet(replace(OPTIONS, **change))
    before = {name: value.clone() for name, value in net.state_dict().items()}
    with pytest.raises(ValueError, match=rf"start: .*net.safetensors holds another architecture: {message}"):
        start_from(net, trained[1])
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_a_file_that_is_missing_or_damaged_is_named(trained, tmp_path):
    with pytest.raises(ValueError, match=r"start: .*none.safetensors: no such file or run folder"):
        start_from(trained[0], tmp_path / "none.safetensors")
    path = trained[1]
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match=r"start: .*net.safetensors: damaged, cut short"):
        start_from(trained[0], path)
