"""Files and options of the commands, read and checked before any long computation starts."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchqm.cli.console import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from torchqm.geometry import Mesh
    from torchqm.matching import MatchParameters

__all__ = [
    "MESH_HELP",
    "METHODS",
    "add_cache",
    "add_parameters",
    "as_plain",
    "fit_parameters",
    "make_parameters",
    "read_mesh",
    "read_symmetry",
    "shape_faults",
]

METHODS = ("quotient", "semi", "paper")

MESH_HELP = ".off, .obj, .ply, .stl, TOSCA .mat, or one of a TOSCA .vert/.tri pair"


def _finite(text: str) -> float:
    """A number that is neither NaN nor infinite."""
    value = float(text)
    if not isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is no finite number")
    return value


# Option, field of MatchParameters, type, what it is. The defaults in the texts are checked by a test.
_OPTIONS: tuple[tuple[str, str, Callable[[str], float], str], ...] = (
    ("--k", "k", int, "eigenfunctions in which the first map is computed (default 30)"),
    (
        "--k-quotient",
        "k_quotient",
        int,
        "eigenfunctions whose symmetric ones a second candidate is grown in (half of the surface is enough); up to k: "
        "no second candidate (default 60; paper and semi 0)",
    ),
    ("--k-max", "k_max", int, "eigenfunctions that the refinement reaches (default 200; paper and semi 300)"),
    ("--n-descriptors", "n_descriptors", int, "energies of the WKS, times of the HKS (default 100)"),
    (
        "--splits",
        "splits",
        int,
        "intervals that each descriptor is split into, section 4.1; 0: no splitting (default 5)",
    ),
    ("--commutativity", "commutativity", _finite, "weight of the commutativity with the Laplacian (default 100)"),
    ("--icp-steps", "icp_steps", int, "steps of quotient ICP, section 4.3 (default 20)"),
    ("--time", "time", _finite, "diffusion time of the deltas, the shape's area being 1 (default 0)"),
    (
        "--local-weight",
        "local_weight",
        _finite,
        "of curvature and WKS against spectral coordinates in the refinement; 0: none (default 2; paper and semi 0)",
    ),
    ("--samples", "n_samples", int, "vertices that stand for the surface (default 2000)"),
    ("--seed", "seed", int, "of the samples; the same seed gives the same maps (default 0)"),
)


def add_cache(parser: argparse.ArgumentParser) -> None:
    """The option ``--cache``."""
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        help="keep the eigenfunctions of the meshes here, and read them from here if they are there, as 'torchqm "
        "prepare' puts them (default: the folder that TORCHQM_CACHE names, else nothing is kept)",
    )


def add_parameters(parser: argparse.ArgumentParser) -> None:
    """The numbers of the method as options."""
    group = parser.add_argument_group("numbers of the method (paper, section 7.4)")
    group.add_argument(
        "--descriptor", choices=("wks", "hks"), help="wave or heat kernel signature (default wks)", default=None
    )
    group.add_argument(
        "--refinement",
        choices=("upsample", "icp", "none"),
        default=None,
        help="upsample: a growing basis (default); icp: ICP at k = 100 and k-max (default of paper and semi)",
    )
    for option, field, kind, text in _OPTIONS:
        group.add_argument(option, dest=field, type=kind, metavar="N" if kind is int else "X", default=None, help=text)


def make_parameters(arguments: argparse.Namespace) -> "MatchParameters":
    """The method's defaults, changed by the options that were given.

    Raises:
        UserError: a value that is not allowed.
    """
    from torchqm.matching import MatchParameters

    base = MatchParameters.of(arguments.method)
    names = ["descriptor", "refinement", *(field for _, field, _, _ in _OPTIONS)]
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    if "k" in given and "k_max" not in given:
        given["k_max"] = max(base.k_max, given["k"])
    try:
        return base.changed(**given)
    except ValueError as error:
        raise UserError(str(error)) from error


def read_mesh(path: Path, seen: dict[Path, "Mesh"]) -> "Mesh":
    """Load a mesh and refuse what cannot be matched.

    Args:
        path: its file.
        seen: meshes read before; a file that is given twice is one mesh, so that its eigenpairs are computed once.

    Raises:
        UserError: with the file's name and its fault.
    """
    from torchqm.geometry import check_mesh, load_mesh

    place = path.resolve()
    if place not in seen:
        with shape_faults():
            mesh = load_mesh(path)
            check_mesh(mesh)
        seen[place] = mesh
    return seen[place]


@contextmanager
def shape_faults() -> Iterator[None]:
    """Faults of a shape become errors for the user; every other exception is a bug and keeps its traceback."""
    from torchqm.geometry import MeshError
    from torchqm.matching import MatchError
    from torchqm.spectral import SpectrumError

    try:
        yield
    except (MatchError, MeshError, SpectrumError) as error:
        raise UserError(str(error)) from error


def fit_parameters(
    parameters: "MatchParameters", meshes: "Iterable[Mesh]", k_max_given: bool
) -> tuple["MatchParameters", list[str]]:
    """Parameters that the smallest mesh allows: its vertices bound the eigenfunctions there are.

    A ``k_max`` that nobody asked for is lowered to half the vertices (or ``k``), with a warning.

    Raises:
        UserError: a mesh has fewer vertices than the eigenfunctions that were asked for.
    """
    # at unit area: in the file's units the squares behind an area may be no doubles
    usable = {mesh.label: int((mesh.normalized().vertex_areas > 0).sum()) for mesh in meshes}
    label = min(usable, key=lambda name: usable[name])
    n = usable[label]
    for asked, option in ((parameters.k, "--k"), (parameters.k_max if k_max_given else 0, "--k-max")):
        if n < asked:
            raise UserError(
                f"{label}: {n} vertices are fewer than the {asked} eigenfunctions asked for ({option} {asked})"
            )
    if n // 2 >= parameters.k_max or k_max_given:
        return parameters, []
    k_max = max(parameters.k, n // 2)
    text = f"{label}: {n} vertices: the refinement stops at {k_max} eigenfunctions instead of {parameters.k_max}"
    return parameters.changed(k_max=k_max), [text]


def read_symmetry(path: Path, mesh: "Mesh") -> tuple["Tensor", list[str]]:
    """A mesh's symmetry from a file, and notes on how the file was read.

    Raises:
        UserError: with the file's name and its fault.
    """
    from torchqm.matching.symmetry_file import SymmetryFileError, load_symmetry

    try:
        symmetry = load_symmetry(path, mesh)
    except SymmetryFileError as error:
        raise UserError(str(error)) from error
    return symmetry.maps, symmetry.notes


def as_plain(arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments as they were given, for ``summary.json``."""
    hidden = ("run", "default_threads")
    return {name: str(v) if isinstance(v, Path) else v for name, v in vars(arguments).items() if name not in hidden}
