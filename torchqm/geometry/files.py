"""Files that appear whole or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

__all__ = ["write_whole"]


def write_whole(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write a file beside its destination, then rename it: a reader, or a crash, never meets half of it.

    Args:
        path: where to; its folder must be there; an old file is replaced.
        write: called with the open binary file.

    Returns:
        ``path``.

    Raises:
        OSError: the place cannot be written to; whatever ``write`` raises goes through. Nothing is left behind.
    """
    path = Path(path)
    handle, beside = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        mask = os.umask(0o022)
        os.umask(mask)
        os.chmod(beside, 0o666 & ~mask)  # mkstemp makes private files; these are not
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise
    return path
