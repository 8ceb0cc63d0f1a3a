"""What a comparison run has to do: a task for each method and pair, and one for each method and shape's symmetry.

Every task has a key, a digest of everything that its result depends on (method and its options, version, shapes, truth,
points, solver). The folder of a method's results carries a digest of its options too, so that results of other options
stay where they are and are never mixed with these.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from torchqm.benchmark.ledger import FORMAT, file_name
from torchqm.data.base import ShapeSet, Truth, TruthError
from torchqm.data.published import PUBLISHED_METHODS
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.learn import LearnedDescriptors, load_net
from torchqm.matching.baselines import MATCHERS, Matcher, Ours
from torchqm.matching.parameters import MatchParameters
from torchqm.version import __version__

__all__ = ["PUBLISHED", "Settings", "Task", "choose_methods", "functions_of", "parameters_of", "plan_tasks"]

LEARNED = "learned:"
"""What the name of a method begins with that takes its descriptors from a trained network; its files come after it."""

PUBLISHED = "published:"
"""What the name of a method begins with whose published results are read."""


@dataclass(frozen=True)
class Settings:
    """What all tasks of a run share.

    Args:
        root: the set of shapes, see :func:`torchqm.data.open_shapes`.
        out: folder of the results.
        points: evaluation points of a pair, spread over the source; 0: all points of the truth; -1: the landmarks of
            the class (SCB).
        solver: of geodesic distances.
        cache: folder of eigenpairs and distances.
    """

    root: str
    out: Path
    points: int = 100
    solver: str = "fast_marching"
    cache: Path | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """One method on one pair (or, of kind ``symmetry``, on one shape).

    Args:
        settings: of the run.
        matcher: the method.
        source: shape that is mapped.
        target: shape that it is mapped to.
        kind: ``pair``, or ``symmetry``: the reflection of ``source``, which is also ``target``.
        path: the result file.
        key: digest of everything that the result depends on.
        prints: digests of the two meshes.
    """

    settings: Settings
    matcher: Matcher
    source: str
    target: str
    kind: Literal["pair", "symmetry"]
    path: Path
    key: str
    prints: tuple[str, str]

    @property
    def label(self) -> str:
        """For progress lines."""
        what = self.source if self.kind == "symmetry" else f"{self.source} → {self.target}"
        return f"{self.matcher.name}, {'symmetry of ' if self.kind == 'symmetry' else ''}{what}"


def choose_methods(names: Iterable[str]) -> tuple[list[Matcher], list[str]]:
    """The matchers of some names, and the published methods among them (without ``published:``).

    ``learned:RUN`` is ``quotient`` with the descriptors of a trained network (:func:`torchqm.learn.load_net`).

    Raises:
        ValueError: an unknown name (the known ones are listed), one that stands there twice, or none; a file of a
            trained network that cannot be used.

    Example:
        >>> matchers, published = choose_methods(["descriptors", "published:BlendedMap"])
        >>> [matcher.name for matcher in matchers], published
        (['descriptors'], ['BlendedMap'])
    """
    matchers, published, seen = [], [], set[str]()
    for name in names:
        if name in seen:
            raise ValueError(f"method {name!r} is given twice")
        seen.add(name)
        if name.startswith(PUBLISHED):
            published.append(name.removeprefix(PUBLISHED))
        elif name.startswith(LEARNED):
            matchers.append(_learned(name))
        elif name in MATCHERS:
            matchers.append(MATCHERS[name])
        else:
            known = [*MATCHERS, f"{LEARNED}RUN", *(PUBLISHED + method for method in PUBLISHED_METHODS)]
            raise ValueError(f"method {name!r}: unknown; allowed are {', '.join(known)}")
    if not seen:
        raise ValueError(f"methods: at least one is needed; allowed are {', '.join(MATCHERS)}")
    return matchers, published


def _learned(name: str) -> Matcher:
    """The classical matcher with learned descriptors; what it is called says where they were read, once."""
    path = name.removeprefix(LEARNED)
    if not path:
        raise ValueError(f"method {name!r}: a run folder, a file or 'builtin' is expected after {LEARNED!r}")
    descriptors = LearnedDescriptors(load_net(path))
    k = descriptors.net.options.k
    parameters = MatchParameters.of("quotient")
    if k > parameters.k_max:
        parameters = parameters.changed(k_max=k)
    return Ours(parameters=parameters, name=name, descriptors=descriptors)


def parameters_of(matcher: Ours) -> MatchParameters:
    """The numbers that one of torchqm's methods runs with."""
    return matcher.parameters or MatchParameters.of(matcher.method)


def functions_of(matcher: Matcher) -> int:
    """Eigenfunctions that a method gets: its own number, so that it does not depend on what it runs beside."""
    if isinstance(matcher, Ours):
        return parameters_of(matcher).k_max
    return max([200, *(int(getattr(matcher, name, 0)) for name in ("k", "k_max", "k_descriptors"))])


def finds_symmetry(matcher: Matcher) -> bool:
    """Whether a method finds the symmetry of a shape, which is then measured too (Figure 8)."""
    return "self" in matcher.needs or (
        isinstance(matcher, Ours) and matcher.method != "semi" and matcher.axis != "true"
    )


def plan_tasks(
    shapes: ShapeSet, matchers: Sequence[Matcher], pairs: Sequence[tuple[str, str]], settings: Settings
) -> list[Task]:
    """All tasks of a run, finished or not: first the symmetries of the shapes, then the pairs, one after the other.

    Args:
        shapes: the set.
        matchers: the methods.
        pairs: which pairs.
        settings: of the run.

    Raises:
        TruthError: a pair without truth, naming the pair and why.
        ValueError: a shape that is not there, or points that the set does not have.
    """
    if settings.points < 0 and not hasattr(shapes, "benchmark"):
        raise ValueError(f"points 'landmarks': {settings.root} ({shapes.layout}) ships no landmarks; give a number")
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    prints = {name: _print(shapes, name) for name in names}
    truths = {pair: _truth_print(shapes, *pair) for pair in pairs}
    mirrors = {name: _mirror_print(shapes, name) for name in names}
    configs = {matcher.name: _config(matcher, settings) for matcher in matchers}
    tasks = []

    def add(matcher: Matcher, source: str, target: str, kind: Literal["pair", "symmetry"], truth: str) -> None:
        config = configs[matcher.name]
        found = (prints[source], prints[target])
        key = _digest([config, kind, source, target, found, truth])
        # The pair itself where it is a pair of two, the shape where it is the shape's symmetry.
        name = file_name(source) if kind == "symmetry" else file_name(source, target)
        path = settings.out / "results" / f"{file_name(matcher.name)}-{_digest(config)[:8]}" / f"{name}.json"
        tasks.append(Task(settings, matcher, source, target, kind, path, key, found))

    for name in names:
        for matcher in matchers:
            if finds_symmetry(matcher):
                add(matcher, name, name, "symmetry", mirrors[name])
    for pair in pairs:
        for matcher in matchers:
            if "self" not in matcher.needs:
                add(matcher, *pair, "pair", truths[pair] + mirrors[pair[1]])
    return tasks


def _config(matcher: Matcher, settings: Settings) -> dict[str, Any]:
    """What the results of a method depend on beside the shapes."""
    numbers = repr(parameters_of(matcher)) if isinstance(matcher, Ours) else ""
    learned = matcher.descriptors if isinstance(matcher, Ours) else None
    # Named only where there are some, so that results of all other methods stay what they were.
    more = {} if learned is None else {"descriptors": repr(learned)}
    return {
        "format": FORMAT,
        "version": __version__,
        "matcher": repr(matcher),
        "parameters": numbers,
        "functions": functions_of(matcher),
        "points": settings.points,
        "solver": settings.solver,
        **more,
    }


def _print(shapes: ShapeSet, name: str) -> str:
    """A digest of a shape: of its file, or of what it is made from."""
    shapes.require(name)
    path = shapes.path(name)
    if path is None:
        return _digest([str(shapes.root), name])
    digest = hashlib.sha256()
    # A .vert file has its triangles beside it.
    for file in (path, path.with_suffix(".tri")) if path.suffix == ".vert" else (path,):
        try:
            digest.update(file.read_bytes())
        except OSError as error:
            raise ValueError(f"{file}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()[:32]


def _truth_print(shapes: ShapeSet, first: str, second: str) -> str:
    """A digest of the truth of a pair, which also shows that there is one before hours of work."""
    if shapes.layout == "synthetic":  # known from the names; making the creatures takes a while
        if shapes.shape_class(first) != shapes.shape_class(second):
            raise TruthError(f"{shapes.root}: no truth from {first} to {second}: they are different bodies")
        return ""
    truth = shapes.truth(first, second)
    if not len(truth):
        raise TruthError(f"{shapes.root}: no truth from {first} to {second}: there is no true point")
    return truth_digest(truth)


def _mirror_print(shapes: ShapeSet, name: str) -> str:
    """A digest of the true reflection of a shape; empty where none is known (its file may come later)."""
    truth = None if shapes.layout == "synthetic" else shapes.symmetry_truth(name)
    return "" if truth is None else truth_digest(truth)


def truth_digest(truth: Truth) -> str:
    """A digest of the true points of a pair."""
    points = truth.points
    arrays = [points.corners, points.bary] if isinstance(points, SurfacePoints) else [points]
    digest = hashlib.sha256()
    for array in (truth.at, *arrays):
        digest.update(torch.as_tensor(array).contiguous().numpy().data)
    return digest.hexdigest()[:32]


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]
