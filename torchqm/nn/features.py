"""What a feature extractor is given at each vertex, by name, and the simplest extractor: a network of points."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchqm.checks import Sizes, require_finite, require_mask, require_nonnegative
from torchqm.geometry.normals import centred_unit_area, normals_at_vertices
from torchqm.nn.descriptors import HeatKernelSignature, WaveKernelSignature
from torchqm.options import require_counts, require_flag, require_number, require_whole

__all__ = ["MLP", "InputFeatures"]


class InputFeatures(nn.Module):
    """Features of the vertices of an item or a batch of :mod:`torchqm.data`, by their names, side by side.

    ===========  ========  ==================================================================  =====================
    name         channels  what                                                                keys of the item
    ===========  ========  ==================================================================  =====================
    ``xyz``      3         position from the centroid, scaled to total area 1                  verts, mass
    ``normals``  3         unit normal                                                         verts, faces, mass
    ``wks``      n         wave kernel signature, less 1 (its mean over every surface)         mass, evals, evecs
    ``hks``      n         heat kernel signature, less 1 (its mean over every surface)         mass, evals, evecs
    ===========  ========  ==================================================================  =====================

    The signatures do not see how a shape is placed or bent, nor which side is left; position and normals see all this.
    None of them changes with the size of a shape. They are not computed in half precision under autocast.

    Args:
        names: what is wanted, in the order of the channels.
        n: energies or times of a signature.
        k: eigenfunctions of the bases that will be given, for the range of energies and times.
        learnable: whether these are parameters.

    Raises:
        ValueError: no name, a name given twice, or an unknown one.

    Example:
        >>> features = InputFeatures(("xyz", "wks"), n=16, k=30)
        >>> features.channels
        19
        >>> item = {"verts": torch.rand(8, 3), "mass": torch.ones(8), "evals": torch.arange(30.0)}
        >>> features(item | {"evecs": torch.rand(8, 30)}).shape
        torch.Size([8, 19])
    """

    KEYS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "xyz": ("verts", "mass"),
        "normals": ("verts", "faces", "mass"),
        "wks": ("mass", "evals", "evecs"),
        "hks": ("mass", "evals", "evecs"),
    }
    """What each feature reads of an item."""

    def __init__(self, names: Sequence[str] = ("wks",), n: int = 128, k: int = 128, learnable: bool = False) -> None:
        super().__init__()
        require_flag("learnable", learnable)
        self.names = (names,) if isinstance(names, str) else tuple(names)
        unknown = [name for name in self.names if name not in self.KEYS]
        if unknown or not self.names or len(set(self.names)) < len(self.names):
            raise ValueError(f"names: {list(self.names)} given; each at most once, allowed are {', '.join(self.KEYS)}")
        self.wks = WaveKernelSignature(n, k, learnable) if "wks" in self.names else None
        self.hks = HeatKernelSignature(n, k, learnable) if "hks" in self.names else None
        self.channels = sum(n if name in ("wks", "hks") else 3 for name in self.names)

    def forward(self, item: Mapping[str, Any]) -> Float[Tensor, "*B V C"]:
        """Features ``(B, V, channels)`` of a batch, ``(V, channels)`` of an item; padded vertices have zeros.

        Args:
            item: dictionary with the keys in the table above, and ``verts_mask`` and ``evals_mask`` if it is padded.

        Raises:
            ValueError: a key is missing, or as in :class:`torchqm.nn.WaveKernelSignature`.
        """
        needed = dict.fromkeys(key for name in self.names for key in self.KEYS[name])
        missing = [key for key in needed if key not in item]
        if missing:
            raise ValueError(
                f"item: without {', '.join(missing)}, which {', '.join(self.names)} needs; it has {', '.join(item)}"
            )
        with torch.autocast(item["mass"].device.type, enabled=False):
            features = torch.cat([self._feature(name, item) for name in self.names], -1)
        mask = item.get("verts_mask")
        if mask is not None:
            sizes = Sizes()
            sizes.bind("mass", item["mass"], "... V")
            sizes.bind("verts_mask", mask, "... V")
            require_mask("verts_mask", mask)
        return features if mask is None else features.masked_fill(~mask[..., None], 0.0)

    def _feature(self, name: str, item: Mapping[str, Any]) -> Tensor:
        mass = item["mass"]
        if name in ("wks", "hks"):
            layer = self.wks if name == "wks" else self.hks
            values: Tensor = layer(item["evals"], item["evecs"], mass, item.get("evals_mask"))  # type: ignore[misc]
            return values - 1
        verts = item["verts"]
        sizes = Sizes()
        sizes.bind("verts", verts, "... V 3")
        sizes.bind("mass", mass, "... V")
        require_finite("verts", verts)
        require_nonnegative("mass", mass)
        require_mask("mass > 0", mass > 0)
        scaled = centred_unit_area(verts, mass)
        return scaled if name == "xyz" else normals_at_vertices(scaled, item["faces"])

    def extra_repr(self) -> str:
        """The names, for ``print``."""
        return f"names={self.names}, channels={self.channels}"


class MLP(nn.Module):
    """The same network at each point: linear layers with ReLU between them.

    Args:
        c_in: channels given.
        c_out: channels returned.
        hidden: channels of the layers between.
        layer_norm: normalise the channels of each point before each ReLU.
        dropout: probability to drop a channel after each ReLU, in training; below 1.

    Raises:
        ValueError: an option out of range.

    Example:
        >>> MLP(16, 4)(torch.zeros(2, 50, 16)).shape
        torch.Size([2, 50, 4])
    """

    def __init__(
        self,
        c_in: int,
        c_out: int,
        hidden: Sequence[int] = (128, 128),
        layer_norm: bool = False,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        require_whole("c_in", c_in)
        require_whole("c_out", c_out)
        require_flag("layer_norm", layer_norm)
        require_number("dropout", dropout, least=0, below=1)
        sizes = (c_in, *require_counts("hidden", hidden), c_out)
        layers: list[nn.Module] = []
        for before, after in pairwise(sizes[:-1]):
            layers += [nn.Linear(before, after), nn.LayerNorm(after) if layer_norm else nn.Identity(), nn.ReLU()]
            layers += [nn.Dropout(dropout)] if dropout else []
        self.c_in = c_in
        self.layers = nn.Sequential(*layers, nn.Linear(sizes[-2], c_out))

    def forward(
        self, feat: Float[Tensor, "*B V C"], verts_mask: Bool[Tensor, "*B V"] | None = None
    ) -> Float[Tensor, "*B V D"]:
        """``(B, V, c_out)`` of features ``(B, V, c_in)``; vertices whose mask is false get zeros.

        Raises:
            ValueError: sizes that do not fit, non-finite features.
        """
        sizes = Sizes()
        sizes.bind("feat", feat, f"... V {self.c_in}")
        require_finite("feat", feat)
        out: Tensor = self.layers(feat)
        if verts_mask is None:
            return out
        sizes.bind("verts_mask", verts_mask, "... V")
        require_mask("verts_mask", verts_mask)
        return out.masked_fill(~verts_mask[..., None], 0.0)
