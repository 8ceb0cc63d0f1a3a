"""The choice of where the tasks of a command are run, and whether what was chosen is there."""

import argparse
import socket
import struct
from urllib.parse import urlsplit

from torchqm.cli.console import UserError

__all__ = ["add_backend", "check_backend", "knock"]


def add_backend(parser: argparse.ArgumentParser) -> None:
    """The options ``--backend`` and ``--address``."""
    parser.add_argument(
        "--backend",
        choices=("local", "dask"),
        default="local",
        help="where pairs are run: in processes of this machine (default), or on the workers of a Dask cluster",
    )
    parser.add_argument("--address", metavar="tcp://HOST:PORT", help="scheduler of the Dask cluster")


def check_backend(backend: str, address: str | None) -> None:
    """Refuse options that do not go together, before anything is read or written.

    Raises:
        UserError: saying which.
    """
    if backend == "local":
        if address is not None:
            raise UserError(f"--address {address}: is of a Dask cluster, so add --backend dask")
        return
    if address is None:
        raise UserError("--backend dask: the scheduler's address is needed too, --address tcp://HOST:PORT")
    try:
        parts = urlsplit(address)
        good = parts.scheme in ("tcp", "tls") and parts.hostname and parts.port and not parts.path.strip("/")
    except ValueError:  # a port that is none
        good = False
    if not good:
        raise UserError(f"--address {address}: is no tcp://HOST:PORT (or tls://HOST:PORT)")
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise UserError(
            f"--backend dask: Dask's scheduler is not installed ({error}); pip install 'torchqm[distributed]'"
        ) from error


def knock(address: str, patience: float) -> None:
    """Whether a scheduler is there. Dask itself waits for ever for the greeting of one that is none.

    Args:
        address: ``tcp://HOST:PORT`` or ``tls://HOST:PORT``.
        patience: seconds.

    Raises:
        UserError: nobody answers, or something else does.
    """
    parts = urlsplit(address)
    try:
        with socket.create_connection((parts.hostname or "", parts.port or 0), patience) as door:
            if parts.scheme == "tls":  # there the client begins
                return
            greeting = door.makefile("rb").read(8)
    except TimeoutError as error:
        raise UserError(f"{address}: no Dask scheduler answers there (within {patience:.0f} s)") from error
    except OSError as error:
        raise UserError(f"{address}: no Dask scheduler answers there ({error.strerror or error})") from error
    if len(greeting) < 8 or struct.unpack("<Q", greeting)[0] > 2**20:  # the length of a short message
        raise UserError(f"{address}: what answers there is no Dask scheduler")
