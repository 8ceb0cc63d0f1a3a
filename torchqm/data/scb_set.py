"""The TOSCA part of the SCB benchmark as a set of shapes; the folder itself is read by :mod:`torchqm.data.scb`."""

from functools import cached_property
from pathlib import Path

from torchqm.data.base import Problem, Truth, TruthFileError
from torchqm.data.folder import SameIdShapes
from torchqm.data.meshes import vertex_count
from torchqm.data.published import PUBLISHED_METHODS, RESULT_FOLDER, read_published
from torchqm.data.scb import SCBenchmark
from torchqm.geometry import MeshError

__all__ = ["ScbShapes"]

_METHOD = "BlendedMap"


class _ReadableBenchmark(SCBenchmark):
    """The benchmark without the meshes whose header cannot be read: one bad file must not hide the others."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.files = dict(self._paths)
        for name, path in self.files.items():
            try:
                vertex_count(path)
            except MeshError:
                del self._paths[name]


class ScbShapes(SameIdShapes):
    """An SCB folder.

    Args:
        root: the folder that holds ``TOSCA/Meshes``.

    Attributes:
        benchmark: landmarks, their symmetry and the published pairs.
    """

    def __init__(self, root: Path) -> None:
        self.benchmark = _ReadableBenchmark(root)
        files = self.benchmark.files
        sentence = f"SCB: TOSCA/Meshes with {len(files)} .off files; the vertex ids of a class agree"
        super().__init__(root, "scb", files, sentence)
        self.recognised.append("landmarks (TOSCA/Corrs/*.pid): 0-based, as the benchmark has them")
        runnable, skipped = self.published_pairs(), self.skipped_pairs()
        if runnable or skipped:
            self.recognised.append(
                f"{len(runnable) + len(skipped)} pairs with a published result of {_METHOD}, {len(runnable)} of them "
                "between shapes that are here under the same name"
            )

    @classmethod
    def recognise(cls, root: Path) -> "ScbShapes | None":
        """The set in a folder (or in that folder's parent, if it is ``TOSCA`` itself), if it is one of this layout."""
        whole = root.resolve()
        place = whole.parent if whole.name == "TOSCA" and not (root / "TOSCA").is_dir() else root
        return cls(place) if (place / "TOSCA" / "Meshes").is_dir() else None

    @property
    def classes(self) -> list[str]:
        """The classes that have a mesh here, sorted."""
        return self.benchmark.classes

    def undeformed(self, cls: str) -> str | None:
        """The pose with an (almost) exact mirror plane; gorillas have none."""
        return self.benchmark.undeformed(cls)

    def symmetry_truth(self, name: str) -> Truth | None:
        """The reflection at all vertices, else (gorillas) at the landmarks of the class; None where neither is known.

        Raises:
            TruthError: the landmarks are needed, and their files cannot be read.
        """
        whole = super().symmetry_truth(name)
        return self.landmark_symmetry(name) if whole is None else whole

    def landmark_symmetry(self, name: str) -> Truth | None:
        """The reflection at the landmarks of the class, as the benchmark ships it; None if it does not."""
        cls = self.shape_class(name)
        try:
            landmarks = self.benchmark.landmarks(cls)
            images = landmarks[self.benchmark.symmetry_landmarks(cls).permutation()]
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise TruthFileError(str(error)) from error
        return Truth(landmarks, images, f"landmarks of TOSCA/Corrs/{cls}.sym.info")

    def published_pairs(self) -> list[tuple[str, str]]:
        """Pairs with a published result that can be compared with it here, see :meth:`skipped_pairs`."""
        return self.benchmark.published_pairs() if self._has_results else []

    def skipped_pairs(self) -> dict[tuple[str, str], str]:
        """Pairs with a published result that cannot be compared with it here, each with the reason."""
        return self.benchmark.skipped_pairs() if self._has_results else {}

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a class come from."""
        truth, symmetry = super().about(cls)
        has_landmarks = (self.benchmark.corr_folder / f"{cls}.sym.info").is_file()
        return truth, "landmarks" if symmetry == "none" and has_landmarks else symmetry

    @cached_property
    def _has_results(self) -> bool:
        return any((self.benchmark.root / RESULT_FOLDER).glob(f"BenchResult_{_METHOD}_*_to_*.txt"))

    def _other_problems(self) -> list[Problem]:
        out = super()._other_problems()
        for cls in self.classes:
            folder = self.benchmark.corr_folder
            try:
                self.benchmark.landmarks(cls)
                self.benchmark.symmetry_landmarks(cls)
            except FileNotFoundError as error:
                out.append(Problem(cls, folder, str(error), "missing"))
            except ValueError as error:
                out.append(Problem(cls, folder, str(error), "malformed"))
        return out + self._result_problems()

    def _result_problems(self) -> list[Problem]:
        folder = self.benchmark.root / RESULT_FOLDER
        if not self._has_results:
            what = f"{folder} has no results of {_METHOD}: there is no list of published pairs"
            return [Problem(RESULT_FOLDER.name, folder, what, "note")]
        out = []
        for path in sorted(path for method in PUBLISHED_METHODS for path in folder.glob(f"BenchResult_{method}_*.txt")):
            try:
                read_published(path)
            except ValueError as error:
                out.append(Problem(path.name, path, str(error), "malformed"))
        reasons: dict[str, list[str]] = {}
        for (first, second), reason in self.skipped_pairs().items():
            reasons.setdefault(reason, []).append(f"{first} -> {second}")
        for reason, pairs in reasons.items():
            absent = "no mesh" in reason and "numbered differently" not in reason
            count = f"{len(pairs)} published pair{'s' if len(pairs) > 1 else ''}"
            what = f"{count} cannot be compared ({', '.join(pairs)}): {reason}"
            out.append(
                Problem(pairs[0] + (", ..." if len(pairs) > 1 else ""), None, what, "missing" if absent else "note")
            )
        return out
