"""DiffusionNet: features learned by diffusion for learned times and by products of gradients."""

from collections.abc import Callable, Sequence
from math import log

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchqm.checks import Sizes, require_finite, require_mask, require_nonnegative
from torchqm.geometry.gradient_features import StackedGradient, gradient_features, stacked_gradient
from torchqm.nn.features import MLP
from torchqm.options import require_call, require_choice, require_counts, require_flag, require_number, require_whole
from torchqm.spectral.diffusion import spectral_diffusion

__all__ = ["DiffusionNet"]

_TIMES = (1e-4, 1e-1)
"""Where times start, from the first channel to the last (area): radii of 0.01 to 0.3 sqrt(area)."""

_OUTPUTS = ("vertices", "global_mean")


class DiffusionNet(nn.Module):
    """A network on surfaces whose result depends little on the triangulation; arguments are those of diffusion-net.

    Each of ``N_block`` blocks diffuses every channel for its own learned time, takes products of the gradients of the
    diffused channels, gives both and its input to an :class:`~torchqm.nn.features.MLP` at each vertex, and adds the
    result to its input. A linear layer before and one after the blocks fit the channels.

    * Shapes of any size are taken at area one. Times are ``exp(log_times) * area``, so always positive; they start
      spread over the scales of a shape instead of at zero, since logarithms learn slowly from there.
    * The numbering of vertices, signs of eigenfunctions and the choice of tangent frames do not matter, nor does a
      rotation of the mesh where ``x_in`` does not see it. With ``with_gradient_rotations`` a mesh and its mirror
      image differ, so that left is told from right if triangles are consistently oriented; without, they do not.
    * Under autocast only the linear layers are in low precision. ``torch.compile(fullgraph=True)`` and
      ``torch.export`` need ``with_gradient_features=False``: they do not take sparse matrices.

    Args:
        C_in: channels given.
        C_out: channels returned.
        C_width: channels inside.
        N_block: number of blocks.
        last_activation: applied to the result, e.g. ``partial(torch.softmax, dim=-1)``.
        outputs_at: ``vertices``, or ``global_mean``, the mean over the surface. For values of triangles, take the mean
            over the corners of each.
        mlp_hidden_dims: hidden channels of the MLP of a block; two layers of ``C_width`` if not given.
        dropout: 0.5 between the layers of the MLP in training, or not; or another probability.
        with_gradient_features: leave the products of gradients out if false.
        with_gradient_rotations: complex, or only real matrices A.
        diffusion_method: ``spectral``.

    Raises:
        ValueError: an option that is not supported.

    Example:
        >>> net = DiffusionNet(C_in=16, C_out=8, C_width=32, N_block=2, with_gradient_features=False)
        >>> evals, evecs = torch.arange(5.0).expand(2, 5), torch.ones(2, 100, 5)
        >>> net(torch.zeros(2, 100, 16), torch.full((2, 100), 0.01), evals=evals, evecs=evecs).shape
        torch.Size([2, 100, 8])

    References:
        N. Sharp, S. Attaiki, K. Crane, M. Ovsjanikov, "DiffusionNet: Discretization Agnostic Learning on Surfaces",
        2022, section 3.
    """

    def __init__(
        self,
        C_in: int,
        C_out: int,
        C_width: int = 128,
        N_block: int = 4,
        last_activation: Callable[[Tensor], Tensor] | None = None,
        outputs_at: str = "vertices",
        mlp_hidden_dims: Sequence[int] | None = None,
        dropout: bool | float = True,
        with_gradient_features: bool = True,
        with_gradient_rotations: bool = True,
        diffusion_method: str = "spectral",
    ) -> None:
        super().__init__()
        for name, count in (("C_in", C_in), ("C_out", C_out), ("C_width", C_width), ("N_block", N_block)):
            require_whole(name, count)
        require_call("last_activation", last_activation)
        require_choice("outputs_at", outputs_at, _OUTPUTS)
        require_choice("diffusion_method", diffusion_method, ("spectral",))
        require_flag("with_gradient_features", with_gradient_features)
        require_flag("with_gradient_rotations", with_gradient_rotations)
        probability = {True: 0.5, False: 0.0}[dropout] if isinstance(dropout, bool) else dropout
        require_number("dropout", probability, least=0, below=1)
        hidden = (C_width, C_width) if mlp_hidden_dims is None else require_counts("mlp_hidden_dims", mlp_hidden_dims)
        self.c_in, self.last_activation, self.outputs_at = C_in, last_activation, outputs_at
        self.with_gradient_features = with_gradient_features
        self.first = nn.Linear(C_in, C_width)
        self.blocks = nn.ModuleList(
            _Block(C_width, hidden, probability, with_gradient_features, with_gradient_rotations)
            for _ in range(N_block)
        )
        self.last = nn.Linear(C_width, C_out)

    def forward(
        self,
        x_in: Float[Tensor, "*B V C_in"],
        mass: Float[Tensor, "*B V"],
        L: Tensor | None = None,
        evals: Float[Tensor, "*B K"] | None = None,
        evecs: Float[Tensor, "*B V K"] | None = None,
        gradX: Tensor | Sequence[Tensor] | None = None,
        gradY: Tensor | Sequence[Tensor] | None = None,
        edges: Int[Tensor, "*B E 2"] | None = None,
        faces: Int[Tensor, "*B F 3"] | None = None,
        verts_mask: Bool[Tensor, "*B V"] | None = None,
    ) -> Float[Tensor, "..."]:
        """Features of each vertex, or of each shape.

        Args:
            x_in: ``(B, V, C_in)``, or ``(V, C_in)`` of one shape (then without B in the others as well).
            mass: ``(B, V)`` vertex areas, zero for padding.
            L: not used.
            evals: ``(B, K)`` eigenvalues; needed.
            evecs: ``(B, V, K)`` eigenfunctions, orthonormal in the mass, zero for padding; needed.
            gradX: sparse derivative along X of each vertex's frame: ``(B, V, V)`` (``stacked`` of
                :func:`torchqm.data.collate`), block-diagonal ``(B V, B V)``, or a list of B. Needed with
                gradient features.
            gradY: likewise along Y.
            edges: not used.
            faces: not used.
            verts_mask: ``(B, V)`` true for real vertices. Padding never changes a shape's result; with the mask its
                own results are 0.

        Returns:
            ``(B, V, C_out)``, or ``(B, C_out)`` for ``global_mean``.

        Raises:
            ValueError: something needed is missing, sizes or dtypes do not fit, non-finite values, negative mass.
        """
        if evals is None or evecs is None:
            raise ValueError("evals, evecs: not given; spectral diffusion needs both")
        self._check(x_in, mass, evals, evecs, verts_mask)
        gradient = None
        if self.with_gradient_features:
            if gradX is None or gradY is None:
                raise ValueError("gradX, gradY: not given; needed unless with_gradient_features=False")
            gradient = stacked_gradient(gradX, gradY, tuple(x_in.shape[:-2]), x_in.shape[-2])
            self._check_dtype("gradX, gradY", gradient.matrix)
        area = mass.sum(-1)
        x = self.first(x_in)
        for block in self.blocks:
            x = block(x, mass, evals, evecs, gradient, area)
        x = self.last(x)
        if self.outputs_at == "global_mean":
            x = (mass[..., None] * x).sum(-2) / torch.where(area > 0, area, 1.0)[..., None]
        if self.last_activation is not None:
            x = self.last_activation(x)
        if verts_mask is not None and self.outputs_at == "vertices":
            x = x.masked_fill(~verts_mask[..., None], 0.0)
        return x

    def _check(self, x_in: Tensor, mass: Tensor, evals: Tensor, evecs: Tensor, verts_mask: Tensor | None) -> None:
        sizes = Sizes()
        sizes.bind("x_in", x_in, f"... V {self.c_in}", any_dtype=True)  # dtypes: see below
        sizes.bind("mass", mass, "... V", any_dtype=True)
        sizes.bind("evecs", evecs, "... V K", any_dtype=True)
        sizes.bind("evals", evals, "... K", any_dtype=True)
        if not torch.is_autocast_enabled(x_in.device.type):
            self._check_dtype("x_in", x_in)
        for name, tensor in (("mass", mass), ("evals", evals), ("evecs", evecs)):
            self._check_dtype(name, tensor)
        if verts_mask is not None:
            sizes.bind("verts_mask", verts_mask, "... V")
            require_mask("verts_mask", verts_mask)
        require_nonnegative("mass", mass)
        for name, tensor in (("x_in", x_in), ("evals", evals), ("evecs", evecs)):
            require_finite(name, tensor)

    def _check_dtype(self, name: str, tensor: Tensor) -> None:
        own = self.first.weight.dtype
        if tensor.dtype != own:
            raise ValueError(
                f"{name}: dtype {tensor.dtype} given, but the weights are {own}; convert one of them, e.g. by "
                f"ItemOptions(dtype={own})"
            )

    def extra_repr(self) -> str:
        """The options that its parts do not show, for ``print``."""
        return f"outputs_at={self.outputs_at!r}, with_gradient_features={self.with_gradient_features}"


class _Block(nn.Module):
    """Diffusion, products of gradients, a network at each point, added to what was given."""

    def __init__(self, width: int, hidden: Sequence[int], dropout: float, gradients: bool, rotations: bool) -> None:
        super().__init__()
        self.log_times = nn.Parameter(torch.linspace(log(_TIMES[0]), log(_TIMES[1]), width))
        self.real = _square(width) if gradients else None
        self.imaginary = _square(width) if gradients and rotations else None
        self.mlp = MLP((3 if gradients else 2) * width, width, hidden, dropout=dropout)

    def forward(
        self,
        x: Tensor,
        mass: Tensor,
        evals: Tensor,
        evecs: Tensor,
        gradient: StackedGradient | None,
        area: Tensor,
    ) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            times = self.log_times.clamp(-30.0, 10.0).exp()  # beyond, nothing changes but the risk of inf * 0
            diffused = spectral_diffusion(x.to(mass.dtype), mass, evals * area[..., None], evecs, times)
            parts = [x, diffused]
            if gradient is not None and self.real is not None:
                length = area[..., None, None].sqrt()
                along_x, along_y = (length * part for part in gradient(diffused))
                parts.append(gradient_features(along_x, along_y, self.real, self.imaginary))
        return x + self.mlp(torch.cat(parts, -1))


def _square(width: int) -> nn.Parameter:
    return nn.Parameter(torch.empty(width, width).uniform_(-(width**-0.5), width**-0.5))
