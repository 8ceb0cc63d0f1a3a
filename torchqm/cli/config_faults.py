"""What goes wrong where the objects of a config are made, as one line: which option it is, and where it stands."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from traceback import walk_tb
from typing import Any

from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchqm.cli.agreement import without_truth
from torchqm.cli.config_errors import placed
from torchqm.cli.config_places import files_of, given_options, on_one_line, place_of
from torchqm.cli.console import UserError
from torchqm.data.base import TruthError
from torchqm.learn.faults import StepError

__all__ = ["refused", "stops", "value_faults"]

_SAID = (ValueError, TypeError, OSError, ImportError, RuntimeError, MisconfigurationException)
"""Kinds of errors whose text says what is wrong; of others the kind is said, too."""

_LIGHTNING = ("pytorch_lightning.", "lightning_fabric.")
_SHOWN = 80  # characters of a value


@contextmanager
def stops(args: Sequence[str]) -> Iterator[None]:
    """A run that cannot go on is told in one line; every other exception is a bug and keeps its traceback.

    Of Lightning's own errors that line is for those that it means for its users, and for those that are about an
    option that was given.

    Args:
        args: of the command line.

    Raises:
        UserError: the line.
    """
    try:
        yield
    except TruthError as error:
        raise UserError(without_truth(error)) from error
    except StepError as error:
        raise UserError(str(error)) from error
    except Exception as error:
        fault = _option_of(error, args) if _modules(error)[-1].startswith(_LIGHTNING) else None
        if fault is None and not isinstance(error, MisconfigurationException):
            raise
        raise UserError(fault or str(error)) from error


@contextmanager
def value_faults(args: Sequence[str], keys: Callable[[], Sequence[str]], option: str = "") -> Iterator[None]:
    """Values of a config that do not fit are the user's to put right; so is a package that is not there.

    Whatever another package raises is told in one line. So are the errors of torchqm that speak of values; its others
    are bugs and keep their traceback.

    Args:
        args: of the command line.
        keys: gives all that the parser knows, such as ``model.lr``.
        option: what is at fault if nothing else is found to be.

    Raises:
        UserError: the line.
    """
    try:
        yield
    except UserError:
        raise
    except TruthError as error:
        raise UserError(without_truth(error)) from error
    except Exception as error:
        if _is_ours(error) and not isinstance(error, ValueError | OSError | ImportError | MisconfigurationException):
            raise
        raise UserError(refused(error, keys(), args, option)) from error


def refused(error: BaseException, keys: Sequence[str], args: Sequence[str], option: str = "") -> str:
    """One line for a value that was refused by whatever was made with it.

    Errors of other packages do not say which option of the config they are about. It is the one among those that were
    given which the text names (if it names several: one whose value it has, too, and the first of them); else the only
    one whose words it has; else the object that could not be made.

    Args:
        error: what was raised.
        keys: as in :func:`torchqm.cli.config_errors.explained`.
        args: likewise.
        option: as in :func:`value_faults`.

    Example:
        >>> refused(TypeError("`devices` should be an int > 0."), [], ["--trainer.devices", "{}"])
        '--trainer.devices: {} given; `devices` should be an int > 0.'
        >>> refused(ValueError("No gpu backend found!"), [], ["--trainer.accelerator=gpu"])
        "--trainer.accelerator: 'gpu' given; No gpu backend found!"
    """
    known = placed(_inside(error)[1], keys, args)
    if known != _inside(error)[1] or (_is_ours(error) and not _inside(error)[0]):
        return known
    return _option_of(error, args, option) or (f"{option}: {known}" if option else known)


def _option_of(error: BaseException, args: Sequence[str], option: str = "") -> str | None:
    """The line of an option that was given, None if none is found."""
    objects, text = _inside(error)
    files = files_of(args)
    given = [one for one in given_options(args, files) if not re.match(r"(model|data|config)\b", one[0])]
    found = _meant(text, given, objects) or next((one for one in given if one[0] == option), None)
    if found is None:
        return None
    key, value = found
    shown = repr(value) if len(repr(value)) <= _SHOWN else f"{repr(value)[:_SHOWN]}..."
    return f"{place_of(key, args, files)}: {shown} given; {text}"


def _inside(error: BaseException) -> tuple[list[str], str]:
    """The classes of which an object could not be made, and why; jsonargparse says of each kind why it is not that."""
    whole = str(error)
    objects = re.findall(r"given class_path '([\w.]+)'", whole) or re.findall(r"class_path='([\w.]+)'", whole)
    if whole.startswith("Does not validate against any of the Union subtypes"):
        said = re.split(r"\n  - ", whole.partition("\nGiven value type: ")[0])[1:]
        whole = next((one for one in said if not re.match("Not a valid subclass|Expected a <class", one)), whole)
    text = on_one_line(re.sub(r"^Problem with given class_path '[^']+':\s*", "", whole))
    return objects, text if isinstance(error, _SAID) else f"{type(error).__name__}: {text}"


def _meant(text: str, given: Sequence[tuple[str, Any]], objects: Sequence[str]) -> tuple[str, Any] | None:
    def says(words: Any) -> re.Match[str] | None:
        return re.search(rf"(?<!\w){re.escape(str(words))}(?!\w)", text) if str(words) else None

    named = [(at.start(), one) for one in given if (at := says(one[0].rpartition(".")[2]))]
    if named:
        return min(named, key=lambda each: (not says(each[1][1]), each[0]))[1]
    valued = [(key, value) for key, value in given if isinstance(value, str) and says(value)]  # numbers say little
    if len({key for key, _ in valued}) == 1:
        return valued[0]
    made = [one for one in given if one[1] in objects]
    return (made[0][0].removesuffix(".class_path"), made[0][1]) if made else None


def _is_ours(error: BaseException) -> bool:
    """Whether torchqm raised it, or called what did, other than by having Lightning make what a config names."""
    return any(name.startswith("torchqm.") and not name.startswith("torchqm.cli.") for name in _modules(error))


def _modules(error: BaseException) -> list[str]:
    """The modules from where it was caught to where it was raised."""
    return [frame.f_globals.get("__name__", "") for frame, _ in walk_tb(error.__traceback__)]
