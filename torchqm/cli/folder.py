"""The folder a command writes: whole or not at all."""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from torchqm.cli.console import UserError

__all__ = ["staged_folder"]

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


@contextmanager
def staged_folder(out: Path, names: Sequence[str]) -> Iterator[Path]:
    """Give an empty hidden folder to write to, and put its files into place when the block ends well.

    The hidden folder is made at once, beside ``out`` or in it, so that a place that cannot be written to is found
    before the work and not after it. If the block fails nothing is left, folders made on the way included; files of an
    earlier run stay as they were. If it ends well, each file replaces the one of its name, and files called ``names``
    that this run did not write are removed, since they would belong to another result.

    Args:
        out: the folder to write; made if need be.
        names: all files the command can write.

    Raises:
        UserError: ``out`` is a file, or cannot be written to.
    """
    made: list[Path] = []
    try:
        base, made = _prepare(out)
        stage = Path(tempfile.mkdtemp(dir=base, prefix=f".{out.name or 'torchqm'}."))
    except OSError as error:
        _remove(made)
        raise UserError(f"{out}: the output folder cannot be made ({error.strerror or error})") from error
    try:
        yield stage
        try:
            _move(stage, out, names)
        except OSError as error:
            raise UserError(f"{out}: cannot be written ({error.strerror or error})") from error
    except BaseException as error:
        shutil.rmtree(stage, ignore_errors=True)
        _remove(made)
        if isinstance(error, OSError) and error.errno in _FULL:
            raise UserError(f"{out}: cannot be written ({error.strerror or error})") from error
        raise
    shutil.rmtree(stage, ignore_errors=True)


def _prepare(out: Path) -> tuple[Path, list[Path]]:
    """The folder for the hidden one, and the folders above ``out`` that had to be made for it."""
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: is a file, so it cannot be the output folder")
    if out.is_dir():
        return out, []
    missing = []
    parent = out.absolute().parent
    while not parent.exists():
        missing.append(parent)
        parent = parent.parent
    if not parent.is_dir():
        raise UserError(f"{out}: {parent} is a file, so no folder can be made in it")
    made: list[Path] = []
    try:
        for folder in reversed(missing):
            folder.mkdir()
            made.append(folder)
    except OSError:
        _remove(made)
        raise
    return out.absolute().parent, made


def _remove(folders: list[Path]) -> None:
    for folder in reversed(folders):
        try:
            folder.rmdir()
        except OSError:  # somebody else put something there in the meantime
            return


def _move(stage: Path, out: Path, names: Sequence[str]) -> None:
    written = [name for name in names if (stage / name).exists()]
    if not out.is_dir():
        mask = os.umask(0)
        os.umask(mask)
        stage.chmod(0o777 & ~mask)  # the hidden folder was for the user alone
        stage.rename(out)
        return
    for name in written:
        (stage / name).replace(out / name)
    for name in set(names) - set(written):
        (out / name).unlink(missing_ok=True)
