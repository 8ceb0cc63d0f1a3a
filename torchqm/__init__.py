"""torchqm: shape matching that knows about symmetry."""

from torchqm.version import __version__ as __version__
