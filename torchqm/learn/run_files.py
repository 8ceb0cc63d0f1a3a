"""Files of a run folder that a later run must not change: what was there is kept under another name."""

from pathlib import Path

from torchqm.geometry.files import write_whole

__all__ = ["set_aside", "write_version"]


def set_aside(path: Path) -> Path:
    """Rename ``metrics.csv`` to the first of ``metrics-1.csv``, ``metrics-2.csv`` and so on that is free.

    Returns:
        The new name.
    """
    number = 1
    while (kept := path.with_name(f"{path.stem}-{number}{path.suffix}")).exists():
        number += 1
    return path.rename(kept)


def write_version(path: Path, text: str) -> None:
    """Write a file; one with another content that is there is set aside, one with the same stays as it is."""
    content = text.encode()
    if path.exists():
        if path.read_bytes() == content:
            return
        set_aside(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: file.write(content))
