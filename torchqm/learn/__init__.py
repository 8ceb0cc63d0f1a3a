"""Floor 7: training, as Lightning modules over the layers; needs the extra ``learn`` (pytorch-lightning).

:class:`MatchNet` and its options are bare torch; pytorch-lightning is imported when :class:`MatchModule` is asked for.
"""

from typing import TYPE_CHECKING, Any

from torchqm.learn.describe import LearnedDescriptors
from torchqm.learn.files import load_net, save_net
from torchqm.learn.net import MatchNet
from torchqm.learn.options import NetOptions

if TYPE_CHECKING:
    from torchqm.learn.module import MatchModule as MatchModule

__all__ = ["LearnedDescriptors", "MatchModule", "MatchNet", "NetOptions", "load_net", "save_net"]


def __getattr__(name: str) -> Any:
    """Load the Lightning module when it is first asked for (PEP 562)."""
    if name != "MatchModule":
        raise AttributeError(f"module 'torchqm.learn' has no attribute {name!r}")
    from torchqm.learn.module import MatchModule

    return MatchModule
