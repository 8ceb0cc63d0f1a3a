"""What a trained network makes of one shape, as descriptors of the classical matcher."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.geometry.gradient import vertex_gradient
from torchqm.learn.files import digest
from torchqm.learn.net import MatchNet
from torchqm.matching.parameters import MatchError
from torchqm.matching.shape import PreparedShape

__all__ = ["LearnedDescriptors", "shape_item"]


@dataclass(frozen=True, eq=False, repr=False)
class LearnedDescriptors:
    """The features of a network for :func:`torchqm.matching.match` and its like, which then refine the map as ever.

    Features are computed in the network's own number of eigenfunctions, with the inputs that it was trained with.
    Its ``repr`` is that of what it computes: equal for equal networks, wherever they were loaded from.

    Args:
        net: a trained network, see :func:`torchqm.learn.load_net`.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.learn import NetOptions
        >>> from torchqm.matching import prepare
        >>> describe = LearnedDescriptors(MatchNet(NetOptions(k=20, channels=8)))
        >>> describe(prepare(creature("quadruped", 500).mesh, k=30)).shape
        torch.Size([..., 8])
    """

    net: MatchNet

    def __call__(self, shape: PreparedShape) -> Float[Tensor, "V C"]:
        """``(V, channels)`` of length one at each vertex.

        Raises:
            MatchError: the shape has fewer eigenfunctions than the network was trained with.
        """
        weight = next(iter(self.net.state_dict().values()))
        item = shape_item(shape, self.net.options.k, "gradients" in self.net.options.keys, weight.dtype)
        was = self.net.training
        self.net.eval()
        with torch.no_grad():
            values: Tensor = self.net.describe(item)[0]
        self.net.train(was)
        return values.to(shape.basis.evecs.dtype)

    def __repr__(self) -> str:
        return f"LearnedDescriptors({digest(self.net)[:16]})"


def shape_item(shape: PreparedShape, k: int, gradients: bool, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
    """A prepared shape as a batch of one, with the keys of :func:`torchqm.data.collate` that networks read.

    Args:
        shape: the shape, of unit area.
        k: eigenfunctions.
        gradients: whether ``gradX`` and ``gradY`` are wanted.
        dtype: of all real numbers.

    Raises:
        MatchError: the shape has fewer than ``k`` eigenfunctions.
    """
    if shape.basis.k < k:
        raise MatchError(
            f"{shape.mesh.label}: {shape.basis.k} eigenfunctions are there, and the network was trained with {k}; "
            "more are needed (k_max), or a finer mesh"
        )
    basis = shape.basis.truncate(k)
    real = {"verts": shape.mesh.verts, "mass": basis.mass, "evals": basis.evals, "evecs": basis.evecs}
    item: dict[str, Any] = {name: value.to(dtype)[None] for name, value in real.items()}
    item["faces"] = shape.mesh.faces[None]
    item["verts_mask"] = torch.ones(1, shape.n_verts, dtype=torch.bool)
    item["evals_mask"] = torch.ones(1, k, dtype=torch.bool)
    if gradients:
        gradient = vertex_gradient(shape.mesh)
        item |= {"gradX": gradient.grad_x.to(dtype), "gradY": gradient.grad_y.to(dtype)}
    return item
