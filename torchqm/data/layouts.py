"""Which set of shapes a folder holds: its layout is recognised by the names of folders and files."""

from collections.abc import Callable
from pathlib import Path

from torchqm.data.base import LayoutError, ShapeSet
from torchqm.data.dt4d import Dt4dShapes
from torchqm.data.faust import FaustRegistrations
from torchqm.data.places import find_place
from torchqm.data.plain import PlainShapes
from torchqm.data.scb_set import ScbShapes
from torchqm.data.shrec07 import Shrec07Shapes
from torchqm.data.shrec16 import Shrec16Shapes
from torchqm.data.shrec19 import Shrec19Shapes
from torchqm.data.smal import SmalShapes
from torchqm.data.tosca import ToscaShapes
from torchqm.data.vts import VtsShapes

__all__ = ["LAYOUTS", "open_shapes"]

LAYOUTS = (
    "scb",  # TOSCA/Meshes/*.off, TOSCA/Corrs, Results
    "shrec16",  # null with cuts or holes: *.off, *.baryc_gt
    "shrec19",  # off (or shapes) with corres/i_j.map
    "dt4d",  # off/CHARACTER/*.off, corres/CHARACTER/*.vts, train.txt, test.txt
    "shrec07",  # 381.off and 381.vts with landmarks
    "smal",  # off (or shapes) with corres/*.vts, animals
    "vts",  # off, shapes or off_2 with corres (or correspondences)/*.vts: FAUST_r, SCAPE_r and their kind
    "faust-registrations",  # tr_reg_000.ply, also in training/registrations
    "tosca-mat",  # cat0.mat with surface.X, Y, Z, TRIV
    "tosca-vert",  # cat0.vert with cat0.tri
    "plain",  # any folder of meshes, with or without pairs.txt
)
"""Layouts of folders, in the order in which they are tried; ``torchqm data check --help`` explains them."""


def open_shapes(root: str | Path) -> ShapeSet:
    """Open a set of shapes, whatever its layout.

    Args:
        root: a folder in one of the :data:`LAYOUTS`, or the built-in creatures: ``synthetic:`` and its options.

    Returns:
        The set; ``layout`` and ``recognised`` say what was recognised and why.

    Raises:
        LayoutError: there is no such folder, or nothing in it is of a known layout.

    Example:
        >>> open_shapes("nowhere/FAUST_r")
        Traceback (most recent call last):
        torchqm.data.base.LayoutError: nowhere/FAUST_r: no such folder
    """
    if str(root).startswith("synthetic:"):
        from torchqm.data.synthetic_set import SyntheticShapes

        return SyntheticShapes(str(root))
    root = Path(root)
    if not root.is_dir():
        raise LayoutError(f"{root}: {'is a file, not a folder' if root.exists() else 'no such folder'}")
    try:
        found = _recognise(root)
    except OSError as error:
        known = error.filename is not None  # else it is one of ours, a sentence with the file's name
        raise LayoutError(f"{error.filename}: cannot be read ({error.strerror})" if known else str(error)) from error
    if found is None:
        known_layouts = f"known are {', '.join(LAYOUTS)} ('torchqm data check --help' explains them)"
        raise LayoutError(f"{root}: {_what_is_there(root)}; {known_layouts}")
    return found


def _recognise(root: Path) -> ShapeSet | None:
    whole: list[Callable[[Path], ShapeSet | None]] = [ScbShapes.recognise, Shrec16Shapes.recognise]
    for recognise in whole:
        if (found := recognise(root)) is not None:
            return found
    place = find_place(root)
    if place is not None:
        for kind in (Shrec19Shapes, Dt4dShapes, Shrec07Shapes, SmalShapes):
            if (shapes := kind.recognise(place)) is not None:
                return shapes
        return VtsShapes(place)
    for recognise in (FaustRegistrations.recognise, ToscaShapes.recognise, PlainShapes.recognise):
        if (found := recognise(root)) is not None:
            return found
    return None


def _what_is_there(root: Path) -> str:
    """What the folder holds instead, and which of its folders would do."""
    children = sorted(path for path in root.iterdir() if not path.name.startswith("."))
    if not children:
        return "the folder is empty"
    for child in children:
        if child.is_dir() and _looks_known(child):
            return f"no known layout, but {child} has one"
    shown = ", ".join(f"{path.name}/" if path.is_dir() else path.name for path in children[:6])
    return f"no known layout (it holds {shown}{', ...' if len(children) > 6 else ''})"


def _looks_known(folder: Path) -> bool:
    try:
        return _recognise(folder) is not None
    except (OSError, ValueError):
        return False
