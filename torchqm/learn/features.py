"""Features of vertices: given ones by name, and a network over them."""

from collections.abc import Mapping
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from torchqm.learn.options import NetOptions
from torchqm.nn import MLP, DiffusionNet, InputFeatures

__all__ = ["FeatureNet"]


class FeatureNet(nn.Module):
    """:class:`torchqm.nn.InputFeatures` and :class:`~torchqm.nn.MLP`, :class:`~torchqm.nn.DiffusionNet` or nothing.

    Args:
        options: ``inputs``, ``network``, ``channels`` and so on.

    Example:
        >>> FeatureNet(NetOptions(signature=12, channels=8)).inputs.channels
        12
    """

    def __init__(self, options: NetOptions) -> None:
        super().__init__()
        o = options
        self.inputs = InputFeatures(o.inputs, o.signature, o.k)
        self.net: MLP | DiffusionNet | None = None
        self.channels = self.inputs.channels if o.network == "none" else o.channels
        if o.network == "mlp":
            self.net = MLP(self.inputs.channels, o.channels, (o.width,) * o.blocks, dropout=o.dropout)
        elif o.network == "diffusion":
            self.net = DiffusionNet(
                *(self.inputs.channels, o.channels, o.width, o.blocks),
                dropout=o.dropout,
                with_gradient_features=o.gradients,
                with_gradient_rotations=o.rotations,
            )

    def forward(self, item: Mapping[str, Any]) -> Float[Tensor, "B V C"]:
        """``(B, V, channels)`` of a padded batch of :func:`torchqm.data.collate`; 0 at padding."""
        given: Tensor = self.inputs(item)
        if self.net is None:
            return given
        if isinstance(self.net, MLP):
            return self.net(given, item["verts_mask"])
        operators = {key: item[key] for key in ("evals", "evecs", "gradX", "gradY") if key in item}
        return self.net(given, item["mass"], verts_mask=item["verts_mask"], **operators)
