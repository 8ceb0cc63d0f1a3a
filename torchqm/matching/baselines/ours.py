"""torchqm's own methods behind the protocol of the comparison: quotient, the paper as published, semi-quotient.

References:
    Ovsjanikov, Merigot, Patraucean, Guibas. Shape matching via quotient spaces. SGP 2013: Algorithm 1 (section 4),
    section 5 (semi-quotient), section 6 (symmetries from a reference), section 7.4 (parameters).
"""

from dataclasses import dataclass, field, replace

from jaxtyping import Float, Int
from torch import Tensor

from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result
from torchqm.matching.collection import METHODS, Collection
from torchqm.matching.known import KnownSymmetry, given_symmetry
from torchqm.matching.outside import Descriptors
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.prepared import match_prepared
from torchqm.matching.result import MatchResult
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.leftright import halves_of_reflection

__all__ = ["AXES", "Ours"]

AXES = ("auto", "reference", "true", "known")
"""Where the symmetries come from: each shape itself, a reference, the truth, or the reference where there is one."""


@dataclass(frozen=True)
class Ours:
    """``quotient`` and its variants, ``paper`` and ``semi``; see :func:`torchqm.matching.match`.

    Symmetries are found anew for each pair, and their time counts, unless a collection keeps them.

    Args:
        method: ``quotient``, ``paper`` or ``semi``.
        axis: ``auto``: from the two shapes alone, whatever else is given. ``reference``: by transfer from
            ``Given.reference``. ``true``: the tables of :class:`Given`. ``known``: the reference if one is given, else
            ``auto``.
        parameters: by default those of the method.
        descriptors: see :func:`torchqm.matching.match`.
        name: in tables.
        needs: see :class:`torchqm.matching.baselines.Matcher`.

    Raises:
        ValueError: an unknown method or axis.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.matching import MatchParameters, prepare
        >>> x = prepare(creature("quadruped", 500).mesh, k=40)
        >>> Ours("paper", parameters=MatchParameters(k=20, k_max=40)).match(x, x).labels
        ('direct', 'mirrored')
    """

    method: str = "quotient"
    axis: str = "auto"
    parameters: MatchParameters | None = None
    name: str = "quotient"
    needs: tuple[str, ...] = ()
    descriptors: Descriptors | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for name, value, allowed in (("method", self.method, METHODS), ("axis", self.axis, AXES)):
            if value not in allowed:
                raise ValueError(f"{name}={value!r}: allowed are {', '.join(allowed)}")

    def match(
        self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING, collection: Collection | None = None
    ) -> BaselineResult:
        """One map a group element; see :class:`torchqm.matching.baselines.Matcher`.

        Args:
            x: source.
            y: target.
            given: what is known of them.
            collection: where symmetries are kept between pairs; by default they are found anew.

        Raises:
            MatchError: a symmetry or the reference is missing, or does not fit.
        """
        given.check(x, y)
        collection = (
            Collection(None, self.method, self.parameters, descriptors=self.descriptors)
            if collection is None
            else collection
        )
        if self.axis == "true":
            result, origin = self._true(x, y, given, collection), "the symmetries are given"
        elif self._refers(given.reference):
            known_x, known_y = (self.symmetry(shape, given.reference, collection) for shape in (x, y))
            result = self._matched(x, y, known_x, known_y, collection)
            origin = "the symmetries come from the reference"
        else:
            result, origin = collection.match(x, y), "the symmetries come from the two shapes"
        k_max, held = collection.parameters.k_max, min(x.basis.k, y.basis.k)
        notes = [origin, *([f"{held} eigenfunctions instead of {k_max}"] if held < k_max else []), *result.warnings]
        return make_result(
            self.name, x, y, result.maps, collection.steps, result.labels, notes, scores=result.scores.tolist()
        )

    def symmetry(self, shape: PreparedShape, reference: PreparedShape | None, collection: Collection) -> KnownSymmetry:
        """The symmetry that the method finds of one shape.

        Args:
            shape: the shape.
            reference: an undeformed pose, for methods that use one.
            collection: where symmetries are kept.

        Raises:
            MatchError: the method needs a reference and there is none.
        """
        if not self._refers(reference):
            return collection.symmetry(shape, "auto")
        if reference is None:
            raise MatchError(f"{self.name}: needs a reference, an undeformed pose of the shape that has a mirror plane")
        known = collection.symmetry(reference, "extrinsic")
        return known if shape.mesh is reference.mesh else collection.transfer(shape, reference, known)

    def _refers(self, reference: PreparedShape | None) -> bool:
        return self.axis == "reference" or (self.axis == "known" and reference is not None)

    def _true(self, x: PreparedShape, y: PreparedShape, given: Given, collection: Collection) -> MatchResult:
        if given.symmetry_x is None or given.symmetry_y is None:
            missing = "symmetry_x" if given.symmetry_x is None else "symmetry_y"
            raise MatchError(f"{self.name}: needs {missing}, the symmetry of that shape as vertex maps")
        with collection.steps("left and right"):
            known_x, known_y = (
                _known(x, given.symmetry_x, given.side_x),
                _known(y, given.symmetry_y, given.side_y),
            )
        return self._matched(x, y, known_x, known_y, collection)

    def _matched(
        self, x: PreparedShape, y: PreparedShape, known_x: KnownSymmetry, known_y: KnownSymmetry, collection: Collection
    ) -> MatchResult:
        return match_prepared(
            x, y, known_x, known_y, self.method, collection.parameters, collection.steps, self.descriptors
        )


def _known(shape: PreparedShape, table: Int[Tensor, "G V"], side: Float[Tensor, " V"] | None) -> KnownSymmetry:
    known = given_symmetry(shape, table)
    if side is None or not known.reflection:
        return known
    return replace(known, sign=halves_of_reflection(shape.mesh, table[1], side).to(known.sign.dtype))
