"""SHREC07 watertight: 400 shapes of 20 classes, ``1.off`` to ``400.off``, and landmarks in ``.vts`` files.

Line k of ``381.vts`` begins with the vertex of landmark k (three zeros may follow); landmarks of a class correspond.
Vertices count from 0 by custom; that is recognised from the numbers. The files lie beside the meshes or in a folder of
their own. The class follows from the number: twenty shapes each, people first, four-legged animals last.

References:
    Giorgi, Biasotti, Paraboschi. SHREC: Shape Retrieval Contest: Watertight Models Track, 2007. Kim, Lipman, Funkhouser
    2011 (the landmarks).
"""

from torchqm.data.base import Problem, Truth
from torchqm.data.files import read_ids
from torchqm.data.meshes import mesh_files
from torchqm.data.places import Place
from torchqm.data.vts import VtsShapes

__all__ = ["Shrec07Shapes"]

# fmt: off
CLASSES = (
    "human", "cup", "glasses", "airplane", "ant", "chair", "octopus", "table", "teddy", "hand",
    "plier", "fish", "bird", "spring", "armadillo", "bust", "mech", "bearing", "vase", "fourleg",
)
# fmt: on
MOST_LANDMARKS = 200
"""With more lines than this a ``.vts`` file is no list of landmarks."""


class Shrec07Shapes(VtsShapes):
    """A folder of SHREC07.

    Args:
        place: where meshes and truth lie.
    """

    default_base = 0
    shares_template = False

    def __init__(self, place: Place) -> None:
        super().__init__(place, "shrec07", title="SHREC07 (numbered shapes with landmarks)")

    @classmethod
    def recognise(cls, place: Place) -> "Shrec07Shapes | None":
        """The set at a place, if its meshes are numbers up to 400 and a first ``.vts`` file is short."""
        names = list(mesh_files(place.meshes))
        if not all(name.isdecimal() and 1 <= int(name) <= 400 for name in names):
            return None
        named = place.root.resolve().name.lower().startswith("shrec07")
        for path in place.truth_files(".vts"):
            try:
                return cls(place) if len(read_ids(path).values) <= MOST_LANDMARKS else None
            except ValueError:
                continue
        return cls(place) if named else None

    def shape_class(self, name: str) -> str:
        """The class that a number belongs to."""
        self.require(name)
        return CLASSES[(int(name) - 1) // 20]

    def truth(self, first: str, second: str) -> Truth:
        """The landmarks of two shapes of a class.

        Raises:
            TruthError: a file is missing or malformed, or the classes differ.
        """
        truth = super().truth(first, second)
        return Truth(truth.at, truth.points, f"{len(truth)} landmarks, {truth.source}")

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a class come from."""
        counts = {len(ids.values) for name, ids in self._raw.items() if self.shape_class(name) == cls}
        return ", ".join(f"{count} landmarks" for count in sorted(counts)) or "none", "none"

    def _other_problems(self) -> list[Problem]:
        """A class without any landmarks is a note, not a list of missing files: they exist for some classes only."""
        with_truth = {self.shape_class(name) for name in self._raw}
        out = super()._other_problems()
        bare = [cls for cls in self.classes if cls not in with_truth]
        if self._raw:
            out = [p for p in out if p.severity != "missing" or p.name not in self._paths or self._known(p, with_truth)]
            out += [Problem(cls, self.place.truth, f"class {cls} has no landmarks", "note") for cls in bare]
        return out

    def _known(self, problem: Problem, with_truth: set[str]) -> bool:
        return self.shape_class(problem.name) in with_truth
