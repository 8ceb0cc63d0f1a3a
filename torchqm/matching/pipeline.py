"""From two meshes to all the equally good dense maps; the symmetries of one (paper, sections 4 to 6)."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.matching.collection import SYMMETRIES, Collection
from torchqm.matching.outside import Descriptors
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.quality import commutativity_score, orientation_agreement
from torchqm.matching.result import MatchResult, SymmetryResult
from torchqm.matching.steps import StepListener

__all__ = ["detect_symmetry", "find_symmetry", "match"]


def match(
    source: Mesh | str | Path,
    target: Mesh | str | Path,
    *,
    symmetry: str | Tensor | np.ndarray = "auto",
    symmetry_source: Tensor | np.ndarray | None = None,
    reference: Mesh | str | Path | None = None,
    method: str = "quotient",
    parameters: MatchParameters | None = None,
    listener: StepListener | None = None,
    cache_dir: str | Path | None = None,
    descriptors: Descriptors | None = None,
) -> MatchResult:
    """All the equally good dense maps from one shape to another.

    First the symmetry of both must be known. With ``symmetry='auto'`` mirror planes are looked for in the reference if
    there is one, else in both shapes; a shape without plane gets its reflection by transfer from one that has it
    (sections 5 and 6.1). If none has, or a shape may have more than its planes show, it is asked its own spectrum
    (:func:`torchqm.matching.detect.detect_group`). Then the two are matched in the quotient (section 4) by the largest
    group that both have.

    Args:
        source: a mesh or its file.
        target: a mesh or its file.
        symmetry: ``auto``; ``extrinsic`` (mirror planes alone); ``detect`` (spectra alone); ``none``; or the target's
            symmetry as ``(G, V_target)`` vertex maps (tensor or array).
        symmetry_source: the source's symmetry as vertex maps, if known; else it is found.
        reference: an undeformed pose of the same shape, whose mirror plane gives both shapes their symmetry.
        method: ``quotient`` (default; what measured best), ``paper`` (sections 4 to 7 with its parameters) or ``semi``
            (section 5 alone: the symmetry of the source is used only to choose between the two points of an orbit).
        parameters: numbers of the method; by default those that belong to ``method``.
        listener: told of each step; see :data:`torchqm.matching.steps.StepListener`.
        cache_dir: folder of eigenpairs; see :func:`torchqm.matching.shape.prepare`.
        descriptors: makes the descriptors of a shape in the place of wave kernel signatures, such as
            :class:`torchqm.learn.LearnedDescriptors`. Symmetries are found without them.

    Returns:
        The maps, source vertex to target vertex, with labels, scores, functional maps, warnings and timings.

    Raises:
        MeshError: a file or mesh that cannot be used; the message names it and its fault.
        SpectrumError: fewer vertices than eigenfunctions.
        ValueError: an unknown method or symmetry, or a symmetry that does not fit.

    References:
        Paper, Algorithm 1 and sections 5 to 7.
    """
    collection = Collection(reference, method, parameters, listener, cache_dir, descriptors)
    return collection.match(source, target, symmetry, symmetry_source)


def find_symmetry(
    mesh: Mesh | str | Path,
    *,
    reference: Mesh | str | Path | None = None,
    parameters: MatchParameters | None = None,
    listener: StepListener | None = None,
    method: str = "quotient",
    symmetry: str = "auto",
    cache_dir: str | Path | None = None,
) -> SymmetryResult:
    """The symmetries of a shape: from its own mirror planes or spectrum, or transferred from an undeformed reference.

    Args:
        mesh: the shape.
        reference: another pose of it that has a mirror plane.
        parameters: of the matching.
        listener: told of each step.
        method: whose way of transfer: ``quotient`` or ``paper``.
        symmetry: without a reference: ``auto`` (mirror planes if they fit firmly, else the spectrum), ``extrinsic``
            (mirror planes alone) or ``detect`` (spectrum alone).
        cache_dir: folder of eigenpairs; see :func:`torchqm.matching.shape.prepare`.

    Returns:
        The group, its name in ``details["group"]``; trivial, with a warning that gives the numbers, if nothing was
        found.
    """
    if symmetry not in SYMMETRIES[:3]:
        raise ValueError(f"symmetry={symmetry!r}: allowed are {', '.join(SYMMETRIES[:3])}")
    collection = Collection(reference, method, parameters, listener, cache_dir)
    mesh = collection.load(mesh)
    collection.steps.total = collection.expected_work(mesh, match=False)
    shape = collection.shape(mesh)
    known = collection.symmetry(shape, symmetry)
    scores = [commutativity_score(m, shape.basis, shape.basis) for m in known.group.maps]
    agreement = [orientation_agreement(shape.mesh, shape.mesh, m) for m in known.group.maps]
    names = {1.0: "direct", -1.0: "mirrored"}
    labels = [names[float(o)] if shape.oriented else "unknown" for o in known.orientation]
    return SymmetryResult(
        known.group.maps,
        ("direct", *labels[1:]),
        torch.tensor(scores, dtype=torch.float64),
        shape.basis.truncate(min(collection.parameters.k_max, shape.basis.k)),
        known.origin,
        [*shape.warnings, *known.warnings],
        collection.parameters.as_dict(),
        dict(collection.steps.seconds),
        {**known.details, "group": known.name, "orientation": agreement},
    )


def detect_symmetry(
    mesh: Mesh | str | Path,
    *,
    parameters: MatchParameters | None = None,
    listener: StepListener | None = None,
    cache_dir: str | Path | None = None,
) -> SymmetryResult:
    """The symmetries of a shape from its own spectrum: no reference, no mirror plane, no landmarks.

    Args:
        mesh: the shape.
        parameters: of the matching.
        listener: told of each step.
        cache_dir: folder of eigenpairs; see :func:`torchqm.matching.shape.prepare`.

    Returns:
        The group, trivial if none was found, with ``verdict`` (``symmetric``, ``ambiguous``, ``asymmetric``), vertex
        maps, functional matrices (``fmaps``), even and odd functions (``symmetrized``), and in ``details`` the numbers
        behind the verdict, see :class:`torchqm.matching.detect.Detection`.
    """
    return find_symmetry(mesh, parameters=parameters, listener=listener, symmetry="detect", cache_dir=cache_dir)
