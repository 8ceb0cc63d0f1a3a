"""DiffusionNet of one shape, step by step: dense matrices, complex numbers, one channel after the other."""

import torch
from torch import Tensor

from torchqm.nn.diffusion_net import DiffusionNet
from torchqm.spectral import SpectralBasis


def dense_net(net: DiffusionNet, x: Tensor, basis: SpectralBasis, grad_x: Tensor, grad_y: Tensor) -> Tensor:
    """What ``net`` (without dropout, of any size) gives at the vertices, on the shape scaled to area one."""
    basis = basis.scaled(float(basis.mass.sum()) ** -0.5)
    parameters = dict(net.named_parameters())
    x = x @ parameters["first.weight"].T + parameters["first.bias"]
    for number in range(len(net.blocks)):
        own = {name[len(f"blocks.{number}.") :]: p for name, p in parameters.items() if f"blocks.{number}." in name}
        times = own["log_times"].exp()
        diffused = torch.empty_like(x)
        for c in range(x.shape[1]):
            heat = basis.evecs @ torch.diag(torch.exp(-times[c] * basis.evals)) @ basis.evecs.T
            diffused[:, c] = heat @ torch.diag(basis.mass) @ x[:, c]
        parts = [x, diffused]
        if "real" in own:
            w = torch.complex(grad_x.to_dense() @ diffused, grad_y.to_dense() @ diffused)
            a = torch.complex(own["real"], own.get("imaginary", torch.zeros_like(own["real"])))
            parts.append(torch.stack([torch.tanh((v.conj() * (a @ v)).real) for v in w]))
        h = torch.cat(parts, 1)
        weights = [p for name, p in own.items() if name.startswith("mlp")]
        for k in range(0, len(weights), 2):
            h = h @ weights[k].T + weights[k + 1]
            h = h.clamp_min(0) if k + 2 < len(weights) else h
        x = x + h
    return x @ parameters["last.weight"].T + parameters["last.bias"]
