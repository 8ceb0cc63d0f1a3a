"""Some poses of one shape: each prepared once, its symmetry found once, any two matched (paper, section 6.2)."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchqm.fmap.threads import in_parallel, one_thread, workers
from torchqm.geometry.check import check_mesh
from torchqm.geometry.io import load_mesh
from torchqm.geometry.mesh import Mesh
from torchqm.matching.known import (
    KnownSymmetry,
    detected_symmetry,
    extrinsic_symmetry,
    given_symmetry,
    no_symmetry,
    transferred_symmetry,
)
from torchqm.matching.outside import Descriptors
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.prepared import COST, DETECTION, match_prepared
from torchqm.matching.result import MatchResult
from torchqm.matching.shape import N_ANCHORS, PreparedShape, completions, prepare
from torchqm.matching.steps import StepListener, Steps
from torchqm.matching.subgroups import first_reflection
from torchqm.spectral.cache import is_cached

__all__ = ["METHODS", "SYMMETRIES", "Collection"]

# Vertices times eigenpairs of a shape whose eigenpairs one thread computes, those of two such shapes at the same
# time: products of one are bound by memory, and each takes half a gigabyte (54,000 vertices, 216 pairs: 1.2 for both).
_SMALL = 15_000_000

METHODS = ("quotient", "paper", "semi")

SYMMETRIES = ("auto", "extrinsic", "detect", "none")
"""Ways to come to a shape's symmetry; a table of vertex maps is another."""


class Collection:
    """Poses of one shape: each mesh is prepared once, its symmetry found once, and any two are matched (section 6.2).

    Args:
        reference: an undeformed pose with a mirror plane; None if the shapes have planes of their own.
        method: one of :data:`METHODS`.
        parameters: by default those of the method.
        listener: told of each step.
        cache_dir: folder of eigenpairs; see :func:`torchqm.matching.shape.prepare`.
        descriptors: see :func:`match`.
    """

    def __init__(
        self,
        reference: Mesh | str | Path | None = None,
        method: str = "quotient",
        parameters: MatchParameters | None = None,
        listener: StepListener | None = None,
        cache_dir: str | Path | None = None,
        descriptors: Descriptors | None = None,
    ) -> None:
        if method not in METHODS:
            raise ValueError(f"method={method!r}: allowed are {', '.join(METHODS)}")
        self.method = method
        self.cache_dir, self.descriptors = cache_dir, descriptors
        self.parameters = parameters or MatchParameters.of(method)
        self.steps = Steps(listener=listener)
        self.way = "full_map" if method == "quotient" else "clustering"
        self._shapes: dict[int, tuple[Mesh, PreparedShape]] = {}
        self._symmetries: dict[tuple[int, str], tuple[PreparedShape, KnownSymmetry]] = {}
        self._files: dict[Path, Mesh] = {}
        self._reference = None if reference is None else self.load(reference)

    def load(self, mesh: Mesh | str | Path) -> Mesh:
        """The mesh, read from its file the first time that is asked for, and checked."""
        if isinstance(mesh, Mesh):
            check_mesh(mesh)
            return mesh
        path = Path(mesh).resolve()
        if path not in self._files:
            loaded = load_mesh(mesh)
            check_mesh(loaded)
            self._files[path] = loaded
        return self._files[path]

    def _load_files(self, *meshes: Mesh | str | Path | PreparedShape) -> None:
        """Load several files at the same time."""
        files = {Path(m).resolve(): m for m in reversed(meshes) if isinstance(m, str | Path)}
        new = [given for path, given in reversed(files.items()) if path not in self._files]
        if len(new) > 1:
            with one_thread():
                in_parallel([partial(self.load, given) for given in new])

    def shape(self, mesh: Mesh | str | Path | PreparedShape) -> PreparedShape:
        """The mesh made ready: checked, scaled to unit area, with its eigenpairs."""
        if isinstance(mesh, PreparedShape):
            return mesh
        if not isinstance(mesh, Mesh) or id(mesh) not in self._shapes:
            mesh = self.load(mesh)
        if id(mesh) not in self._shapes:
            with self.steps(f"eigenpairs of {mesh.name}", COST["eigenpairs"] * mesh.n_verts / 1000):
                prepared = self._prepared(mesh)
            self._shapes[id(mesh)] = (mesh, prepared)  # the mesh is kept so that its id stays its own
        return self._shapes[id(mesh)][1]

    def _prepared(self, mesh: Mesh) -> PreparedShape:
        """With its eigenpairs; those of small shapes always by one thread, so that all runs give the same digits."""
        p = self.parameters
        with one_thread() if self._is_small(mesh) else nullcontext():
            return prepare(mesh, p.k_max, max(p.n_samples, N_ANCHORS), p.seed, cache_dir=self.cache_dir)

    def _is_small(self, mesh: Mesh) -> bool:
        return mesh.n_verts * self.parameters.k_max <= _SMALL

    def _read(self, *meshes: Mesh | PreparedShape) -> None:
        """Make several meshes ready at the same time: read from the cache, or computed where they are small."""
        new = [m for m in dict.fromkeys(meshes) if isinstance(m, Mesh) and id(m) not in self._shapes]
        if len(new) < 2 or torch.get_num_threads() < 2:
            return
        if not all(map(self._is_small, new)) and not all(
            is_cached(m, self.parameters.k_max, cache_dir=self.cache_dir) for m in new
        ):
            return

        def ready(mesh: Mesh) -> None:
            self._shapes[id(mesh)] = (mesh, self._prepared(mesh))

        for number, mesh in enumerate(new):
            with self.steps(f"eigenpairs of {mesh.name}", COST["eigenpairs"] * mesh.n_verts / 1000):
                if number == 0:  # and of the others
                    with one_thread():
                        in_parallel([partial(ready, m) for m in new])

    def symmetry(self, shape: PreparedShape, how: str = "extrinsic") -> KnownSymmetry:
        """The shape's symmetry: from the reference if there is one, else from itself.

        Args:
            shape: the shape.
            how: without a reference: ``extrinsic`` (its mirror planes), ``detect`` (its spectrum), or ``auto``: the
                planes if they fit firmly (and the spectrum if it shows more), else what the spectrum says, else the
                plane that fits roughly.
        """
        key = (id(shape), f"{how} or reference")
        if key not in self._symmetries:
            if self._reference is not None and self.shape(self._reference) is not shape:
                reference = self.shape(self._reference)
                known = self.transfer(shape, reference, self.symmetry(reference, how))
            elif how == "auto":
                known = self.own_symmetry(shape, "extrinsic")
                if known.firm:
                    known = self._larger(shape, known)
                else:
                    detected = self.own_symmetry(shape, "detect")
                    known = detected if detected.firm or not known.known else known
            else:
                known = self.own_symmetry(shape, how)
            self._symmetries[key] = (shape, known)  # kept like the meshes above
        return self._symmetries[key][1]

    def own_symmetry(self, shape: PreparedShape, how: str) -> KnownSymmetry:
        """The symmetry that a shape itself shows, by its mirror planes or its spectrum; a reference is not asked."""
        key = (id(shape), how)
        if key not in self._symmetries:
            self._find_own(how, shape)
        return self._symmetries[key][1]

    def _find_own(self, how: str, *shapes: PreparedShape) -> None:
        """:meth:`own_symmetry` of several shapes, at the same time where there are workers.

        Planes of two shapes take unequally long; a worker that is done prepares what the match needs after them.
        """
        new = [s for s in dict.fromkeys(shapes) if (id(s), how) not in self._symmetries]
        at_once = max(1, len(new)) if workers() > 1 else 1
        beside: list[Callable[[], None]] = []
        if workers() > 1 and how == "extrinsic" and self.method == "quotient":
            beside = completions(new, self.parameters.local_weight > 0)
        for start in range(0, len(new), at_once):
            part, known = new[start : start + at_once], list[KnownSymmetry]()
            for number, shape in enumerate(part):
                name, cost = f"mirror plane of {shape.mesh.name}", COST["plane"] * shape.n_verts / 1000
                if how == "detect":
                    name = f"symmetry of {shape.mesh.name} from its spectrum"
                    cost = DETECTION + COST["detect"] * shape.n_verts / 1000
                    self.steps.total += cost  # only now is it known that this is needed: what is left grows by it
                with self.steps(name, cost):  # the first step is that of all
                    tasks: list[Callable[[], Any]] = [*(partial(self._own, how, s) for s in part), *beside]
                    known = known or in_parallel(tasks)[: len(part)]
                self._symmetries[(id(shape), how)] = (shape, known[number])

    def _own(self, how: str, shape: PreparedShape) -> KnownSymmetry:
        return detected_symmetry(shape, self.parameters) if how == "detect" else extrinsic_symmetry(shape)

    def _larger(self, shape: PreparedShape, known: KnownSymmetry) -> KnownSymmetry:
        """The group that the spectrum shows, if it is larger: a pose may have kept a few of many mirror planes.

        One plane is what most shapes have, and more than three a posed shape hardly keeps: neither is doubted.
        """
        if known.origin != "extrinsic" or not 2 <= known.details.get("planes", 1) <= 3:
            return known
        found = self.own_symmetry(shape, "detect")
        return found if found.firm and found.group.order > known.group.order else known

    def transfer(self, shape: PreparedShape, reference: PreparedShape, known: KnownSymmetry) -> KnownSymmetry:
        """A shape's symmetry by transfer from another; trivial if that has none."""
        if not known.known:
            return no_symmetry(shape, list(known.warnings))
        if not known.reflection:
            # What is transferred is one reflection; a larger group is looked for in the shape itself first.
            found = self.own_symmetry(shape, "detect")
            if found.known:
                return found
            single = first_reflection(reference, known)
            if single is None:
                text = (
                    f"{reference.mesh.label}: its symmetry ({known.name}) has no reflection that could be transferred"
                )
                return no_symmetry(shape, [*found.warnings, text])
            known = single
        with self.steps(f"symmetry transfer to {shape.mesh.name}", COST["transfer"] * shape.n_verts / 1000):
            return transferred_symmetry(shape, reference, known, self.parameters, self.way)

    def match(
        self,
        source: Mesh | str | Path | PreparedShape,
        target: Mesh | str | Path | PreparedShape,
        symmetry: str | Tensor | np.ndarray = "auto",
        symmetry_source: Tensor | np.ndarray | None = None,
    ) -> MatchResult:
        """Match two poses; arguments and result as in :func:`match`."""
        earlier = dict(self.steps.seconds)
        self._load_files(source, target)
        meshes = [m if isinstance(m, PreparedShape) else self.load(m) for m in (source, target)]
        self.steps.total = self.steps.done + self.expected_work(
            *meshes, symmetries=not isinstance(symmetry, str) or symmetry != "none"
        )
        self._read(*meshes)
        x, y = (self.shape(m) for m in meshes)
        if self._reference is not None and not (isinstance(symmetry, str) and symmetry == "none"):
            self.shape(self._reference)  # eigenpairs use all threads
        with one_thread():
            known_x, known_y = self._both(x, y, symmetry, symmetry_source)
            result = match_prepared(x, y, known_x, known_y, self.method, self.parameters, self.steps, self.descriptors)
        return replace(result, seconds=self.steps.since(earlier))

    def _both(
        self,
        x: PreparedShape,
        y: PreparedShape,
        symmetry: str | Tensor | np.ndarray,
        symmetry_source: Tensor | np.ndarray | None,
    ) -> tuple[KnownSymmetry, KnownSymmetry]:
        """The symmetries of two shapes, each transferred from the other where only one has its own."""
        if not isinstance(symmetry, str):
            symmetry = torch.as_tensor(symmetry)
        elif symmetry == "none":
            if symmetry_source is not None:
                raise ValueError("symmetry='none' asks for no symmetry at all, but symmetry_source was given")
            return no_symmetry(x), no_symmetry(y)
        known_x = None if symmetry_source is None else given_symmetry(x, torch.as_tensor(symmetry_source))
        how = "extrinsic" if isinstance(symmetry, Tensor) else symmetry
        if how not in SYMMETRIES:
            raise ValueError(f"symmetry={how!r}: allowed are {', '.join(SYMMETRIES)} or a table of vertex maps")
        first = "extrinsic" if how == "auto" else how
        if first == "extrinsic" and isinstance(symmetry, str) and symmetry_source is None and self._reference is None:
            self._find_own("extrinsic", y, x)
        known_y = given_symmetry(y, symmetry) if isinstance(symmetry, Tensor) else self.symmetry(y, first)
        if known_x is None and (isinstance(symmetry, str) or self.method != "semi"):
            known_x = self.symmetry(x, first)
        if how == "auto" and known_x is not None and not (known_x.firm or known_y.firm):
            # Nothing to rely on; a transfer from a shape with a firm plane would be quicker, and as good.
            if symmetry_source is None:
                if self._reference is None:
                    self._find_own("detect", x, y)
                known_x = self.symmetry(x, "auto")
            known_y = self.symmetry(y, "auto")
        if known_x is None or _gives_way(known_x, known_y):
            known_x = self.transfer(x, y, known_y)
        elif _gives_way(known_y, known_x):
            known_y = self.transfer(y, x, known_x)
        if how == "auto" and self.method == "quotient":
            known_x, known_y = self._at_least(x, known_x, known_y), self._at_least(y, known_y, known_x)
        return known_x, known_y

    def _at_least(self, shape: PreparedShape, mine: KnownSymmetry, other: KnownSymmetry) -> KnownSymmetry:
        """The group that the spectrum shows, if the other shape has a larger one than is known here, and it helps."""
        if mine.origin == "extrinsic" and mine.group.order < other.group.order:
            found = self.own_symmetry(shape, "detect")
            return found if found.group.order > mine.group.order else mine
        return self._larger(shape, mine)

    def expected_work(self, *meshes: Mesh | PreparedShape, symmetries: bool = True, match: bool = True) -> float:
        """Expected work, in the unit of ``COST``; what was done for an earlier pair costs nothing.

        Args:
            *meshes: the shapes, source first.
            symmetries: whether their symmetries are to be found: by transfer to all if there is a reference, else by
                mirror planes and one transfer.
            match: whether they are matched after that.
        """
        reference = [] if self._reference is None else [self._reference]
        new = [m for m in [*meshes, *reference] if isinstance(m, Mesh) and id(m) not in self._shapes]
        work = COST["eigenpairs"] * sum(m.n_verts for m in new)
        if symmetries:
            work += COST["plane"] * sum(m.n_verts for m in reference or meshes)
            moved = meshes if reference else meshes[:1] if match else ()
            work += COST["transfer"] * sum(m.n_verts for m in moved)
        if match:
            work += (COST["quotient"] + COST["maps"]) * meshes[0].n_verts
        return work / 1000


def _gives_way(mine: KnownSymmetry, other: KnownSymmetry) -> bool:
    """Whether a transfer from the other shape is better than what is known here.

    A doubtful reflection of one's own (a pose that is nearly symmetric) gives way to a firm symmetry of the other
    shape; what the user or the reference gave does not.
    """
    return (other.known and not mine.known) or (
        other.firm and not mine.firm and mine.origin in ("extrinsic", "detected")
    )
