"""What goes wrong where the objects of a config are made, as one line: which option it is, and where it stands."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchqm.cli.agreement import without_truth
from torchqm.cli.config_errors import placed
from torchqm.cli.config_places import given_options, on_one_line, place_of, sources_of
from torchqm.cli.config_traces import causes, group_made, modules, objects_made
from torchqm.cli.console import UserError
from torchqm.data.base import TruthError
from torchqm.learn.faults import StepError

__all__ = ["refused", "stops", "value_faults"]

_SAID = (ValueError, TypeError, OSError, ImportError, RuntimeError, MisconfigurationException)
"""Kinds of errors whose text says what is wrong; of others the kind is said, too."""

_LIGHTNING = ("pytorch_lightning.", "lightning_fabric.")
_LIBRARIES = {"torchqm", "pytorch_lightning", "lightning_fabric", "lightning", "jsonargparse", "torch", "builtins"}
"""Packages that hold no code of the user, also where a config names a class of theirs."""

_ON_THE_WAY = (*_LIGHTNING, "lightning_utilities.", "torch.")

_SHOWN = 80  # characters of a value


@contextmanager
def stops(args: Sequence[str]) -> Iterator[None]:
    """A run that cannot go on is told in one line; every other exception is a bug and keeps its traceback.

    Of Lightning's own errors that line is for those that it means for its users, and for those that quote an option
    that was given, or its value; but not where code of a module, of data or of a callback of a config asked Lightning:
    what the text quotes is that code's then.

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
        fault = _option_of(error, args, quoted=True) if _is_lightnings(error) else None
        if fault is None and not isinstance(error, MisconfigurationException):
            raise
        raise UserError(fault or str(error)) from error


@contextmanager
def value_faults(args: Sequence[str], keys: Callable[[], Sequence[str]], option: str = "") -> Iterator[None]:
    """Values of a config that do not fit are the user's to put right; so is a package that is not there.

    Whatever another package raises that makes what the config names is told in one line. So are the errors of torchqm
    that speak of values. Its others, and those of classes of the user's own that the config names, are bugs and keep
    their traceback.

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
        bug = causes(error)[-1]
        if not (_is_ours(error) and not _is_of_value(error)) and not _is_users(error, args):
            raise UserError(refused(error, keys(), args, option)) from error
        if bug is error:
            raise
    else:
        return
    raise bug  # not the text that jsonargparse made of it


def refused(error: BaseException, keys: Sequence[str], args: Sequence[str], option: str = "") -> str:
    """One line for a value that was refused by whatever was made with it.

    Errors of other packages do not say which option of the config they are about. If an object could not be made, it is
    one of its arguments, else the object. Else, among all those that were given, it is the one which the text names (if
    it names several: one whose value it has, too, and the first of them), else the only one whose words it has.

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
    objects, text = _inside(error)
    known = placed(text, keys, args)
    if known != text or (_is_ours(error) and not objects):
        return known
    return _option_of(error, args, option) or (f"{option or objects[0]}: {known}" if option or objects else known)


def _option_of(error: BaseException, args: Sequence[str], option: str = "", quoted: bool = False) -> str | None:
    """The line of an option that was given, None if none is found."""
    objects, text = _inside(error)
    sources = sources_of(args)
    given = [one for one in given_options(sources) if not re.match(r"(model|data|config)\b", one[0])]
    if objects:
        found = _of_object(text, given, objects[0], error)
    else:
        found = _meant(text, given, quoted) or next((one for one in given if one[0] == option), None)
    if found is None:
        return None
    key, value = found
    shown = repr(value) if len(repr(value)) <= _SHOWN else f"{repr(value)[:_SHOWN]}..."
    return f"{place_of(key, sources)}: {shown} given; {text}"


def _inside(error: BaseException) -> tuple[list[str], str]:
    """The class of which an object could not be made, if there is one, and why.

    jsonargparse says of each kind that an option may have why it is not that.
    """
    cause, whole = causes(error)[-1], str(causes(error)[-1])
    objects = [f"{made.__module__}.{made.__qualname__}" for made, _ in objects_made(error)[-1:]]
    objects = objects or re.findall(r"^Problem with given class_path '([\w.]+)'", whole, re.MULTILINE)
    if whole.startswith("Does not validate against any of the Union subtypes"):
        said = re.split(r"\n  - ", whole.partition("\nGiven value type: ")[0])[1:]
        whole = next((one for one in said if not re.match("Not a valid subclass|Expected a <class", one)), whole)
        objects = objects or re.findall(r"^Problem with given class_path '([\w.]+)'", whole)
    text = on_one_line(re.sub(r"^Problem with given class_path '[^']+':\s*", "", whole))
    return objects, text if isinstance(cause, _SAID) else f"{type(cause).__name__}: {text}"


def _of_object(text: str, given: Sequence[tuple[str, Any]], name: str, error: BaseException) -> tuple[str, Any] | None:
    """An argument of an object of this class, else the object, else none; without a class in the config, of a group."""
    arguments: dict[str, Any] = next((values for _, values in objects_made(error)[::-1]), {})
    found = []
    for i, (key, value) in enumerate(given):
        if not _is_class(key, value, name):
            continue
        whole, after = key.removesuffix(".class_path"), given[i + 1 :]
        end = next((j for j, one in enumerate(after) if one[0] == key), len(after))  # the next of a list
        own = [one for one in after[:end] if one[0].startswith((f"{whole}.", f"{whole.removesuffix('+')}."))]
        differ = sum(arguments.get(inner.rpartition(".")[2]) != part for inner, part in own)
        found.append((differ, _meant(text, own) or (whole, value)))
    if found:
        return min(found, key=lambda each: each[0])[1]
    group = group_made(error)
    return _meant(text, [one for one in given if group and one[0].startswith(f"{group}.")])


def _is_class(key: str, value: Any, name: str) -> bool:
    """Whether an option names a class, by its dotted name (which may be another than where it was written) or short."""
    same = isinstance(value, str) and value.rpartition(".")[2] == name.rpartition(".")[2]
    return same and (key.endswith(".class_path") or (key.startswith("trainer.") and "." in name))


def _meant(text: str, given: Sequence[tuple[str, Any]], quoted: bool = False) -> tuple[str, Any] | None:
    """The option that a text is about.

    A name counts in quotes, and where it is no word of English (``val_check_interval``); the value of an option of the
    trainer itself counts as a word, other values in quotes. With ``quoted`` nothing counts but in quotes.
    """

    def says(words: Any) -> re.Match[str] | None:
        return re.search(rf"(?<!\w){re.escape(str(words))}(?!\w)", text) if str(words) else None

    def quotes(words: str) -> re.Match[str] | None:
        # `name`, 'name', "name", `name=value`, `Trainer(name=value)`
        return re.search(rf"(?<=[`'\"(]){re.escape(words)}(?=[`'\"=])", text) if words else None

    def names(word: str) -> re.Match[str] | None:
        return quotes(word) or (says(word) if "_" in word and not quoted else None)

    named = [(at.start(), one) for one in given if (at := names(one[0].rpartition(".")[2]))]
    if named:
        return min(named, key=lambda each: (not says(each[1][1]), each[0]))[1]
    texts = [(key, value) for key, value in given if isinstance(value, str)]  # numbers say little
    valued = [(key, value) for key, value in texts if (says if key.count(".") == 1 and not quoted else quotes)(value)]
    return valued[0] if len({key for key, _ in valued}) == 1 else None


def _is_ours(error: BaseException) -> bool:
    """Whether torchqm raised it, or called what did, other than by having Lightning make what a config names."""
    names = modules(error)
    last = max((i for i, name in enumerate(names) if name.startswith("torchqm.")), default=None)
    return last is not None and "pytorch_lightning.cli" not in names[last + 1 : last + 2]


def _is_of_value(error: BaseException) -> bool:
    """Whether it is of a kind by which torchqm refuses a value; a ValueError that it did not raise itself is none."""
    cause = causes(error)[-1]
    if isinstance(cause, OSError | ImportError | UnicodeError | MisconfigurationException):
        return True
    return isinstance(cause, ValueError) and modules(error)[-1].startswith("torchqm.")


def _is_users(error: BaseException, args: Sequence[str]) -> bool:
    """Whether it went through a package that is none of the libraries, and that a config has a class of.

    An error that Lightning has for its users is no bug there either.
    """
    named = [value for key, value in given_options(sources_of(args)) if _is_class(key, value, str(value))]
    packages = {str(name).partition(".")[0] for name in (*named, *(made.__module__ for made, _ in objects_made(error)))}
    own = any(name.partition(".")[0] in packages - _LIBRARIES for name in modules(error))
    return own and not isinstance(causes(error)[-1], MisconfigurationException)


def _is_lightnings(error: BaseException) -> bool:
    """Whether Lightning raised it, and on the way from the commands there was nothing but Lightning."""
    names = modules(error)
    begin = max((i + 1 for i, name in enumerate(names) if name.startswith("torchqm.cli.")), default=0)
    return names[-1].startswith(_LIGHTNING) and all(name.startswith(_ON_THE_WAY) for name in names[begin:])
