"""Shape matching that knows about symmetry: quotient-space functional maps in PyTorch.

From two triangle meshes, all the equally good dense maps between them (Ovsjanikov, Mérigot, Pătrăucean, Guibas, "Shape
Matching via Quotient Spaces", 2013). The names below are loaded on first use, so ``import torchqm`` is quick; all
else is in the subpackages ``geometry, spectral, symmetry, fmap, matching, nn, learn, data, evaluate, viz``.

Example:
    >>> import torchqm
    >>> mesh = torchqm.creature("quadruped", 1000).mesh
    >>> symmetry = torchqm.find_symmetry(mesh, parameters=torchqm.MatchParameters(k_max=30))
    >>> symmetry.labels
    ('direct', 'mirrored')
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchqm.version import __version__ as __version__

if TYPE_CHECKING:
    from torchqm.data.synthetic import creature as creature
    from torchqm.data.synthetic import exact_maps as exact_maps
    from torchqm.fmap import fmap_to_p2p as fmap_to_p2p
    from torchqm.fmap import p2p_to_fmap as p2p_to_fmap
    from torchqm.fmap import quotient_icp as quotient_icp
    from torchqm.fmap import solve_fmap as solve_fmap
    from torchqm.geometry import Mesh as Mesh
    from torchqm.geometry import MeshError as MeshError
    from torchqm.geometry import load_mesh as load_mesh
    from torchqm.geometry import save_mesh as save_mesh
    from torchqm.matching import Collection as Collection
    from torchqm.matching import MatchParameters as MatchParameters
    from torchqm.matching import MatchResult as MatchResult
    from torchqm.matching import SymmetryResult as SymmetryResult
    from torchqm.matching import detect_symmetry as detect_symmetry
    from torchqm.matching import find_symmetry as find_symmetry
    from torchqm.matching import match as match
    from torchqm.matching.symmetry_file import load_symmetry as load_symmetry
    from torchqm.spectral import SpectralBasis as SpectralBasis
    from torchqm.spectral import mesh_basis as mesh_basis
    from torchqm.symmetry import EvenOddBasis as EvenOddBasis
    from torchqm.symmetry import SymmetryGroup as SymmetryGroup
    from torchqm.symmetry import even_part as even_part
    from torchqm.symmetry import odd_part as odd_part
    from torchqm.symmetry import symmetrized_basis as symmetrized_basis

__all__ = [
    "Collection",
    "EvenOddBasis",
    "MatchParameters",
    "MatchResult",
    "Mesh",
    "MeshError",
    "SpectralBasis",
    "SymmetryGroup",
    "SymmetryResult",
    "__version__",
    "creature",
    "detect_symmetry",
    "even_part",
    "exact_maps",
    "find_symmetry",
    "fmap_to_p2p",
    "load_mesh",
    "load_symmetry",
    "match",
    "mesh_basis",
    "odd_part",
    "p2p_to_fmap",
    "quotient_icp",
    "save_mesh",
    "solve_fmap",
    "symmetrized_basis",
]

_HOMES = {
    "torchqm.data.synthetic": ("creature", "exact_maps"),
    "torchqm.fmap": ("fmap_to_p2p", "p2p_to_fmap", "quotient_icp", "solve_fmap"),
    "torchqm.geometry": ("Mesh", "MeshError", "load_mesh", "save_mesh"),
    "torchqm.matching": (
        "Collection",
        "MatchParameters",
        "MatchResult",
        "SymmetryResult",
        "detect_symmetry",
        "find_symmetry",
        "match",
    ),
    "torchqm.matching.symmetry_file": ("load_symmetry",),
    "torchqm.spectral": ("SpectralBasis", "mesh_basis"),
    "torchqm.symmetry": ("EvenOddBasis", "SymmetryGroup", "even_part", "odd_part", "symmetrized_basis"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
_SUBPACKAGES = (
    *("checks", "data", "evaluate", "fmap", "geometry", "learn", "matching", "nn", "spectral", "symmetry", "testing"),
    "viz",
)


def __getattr__(name: str) -> Any:
    """Load a public name, or a subpackage, when it is first asked for (PEP 562)."""
    if name in _SUBPACKAGES:
        return import_module(f"torchqm.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'torchqm' has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBPACKAGES])
