"""pyFM (R. Magnet) through its own package ``pyfmaps``: its functional map, ICP and ZoomOut, with its own defaults.

References:
    https://github.com/RobinMagnet/pyFM (MIT), version 1.3.
"""

from dataclasses import dataclass
from importlib.metadata import version
from types import ModuleType
from typing import Any

import numpy as np
import torch

from torchqm.geometry.sampling import farthest_points
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result, shared_size
from torchqm.matching.parameters import MatchError
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps

__all__ = ["PyFM"]


@dataclass(frozen=True)
class PyFM:
    """``pyfm``: what a user of pyFM gets from ``preprocess``, ``fit``, ``icp_refine`` and ``zoomout_refine``.

    pyFM maps the vertices of its second mesh to its first, so x is its second. It gets the eigenpairs of the prepared
    shapes, as every method does here: computing its own would only add to its time.

    Args:
        k: size of its functional map (its default).
        k_max: size that ZoomOut reaches.
        step: by which ZoomOut grows.
        n_descriptors: of the wave kernel signature (its default).
        k_descriptors: eigenfunctions in the descriptors (its default), at most.
        icp: whether its ICP is run before ZoomOut; all vertices are compared with all in each of its ten steps.
        n_samples: farthest points that its ZoomOut looks at (its option ``subsample``); None: all vertices, as it does
            by default. That was half an hour for two cats of TOSCA (28,000 vertices) on a busy core.
        name: in tables.
        needs: see :class:`torchqm.matching.baselines.Matcher`.
    """

    k: int = 50
    k_max: int = 200
    step: int = 5
    n_descriptors: int = 100
    k_descriptors: int = 128
    icp: bool = False
    n_samples: int | None = 3000
    name: str = "pyfm"
    needs: tuple[str, ...] = ()

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """One map; see :class:`torchqm.matching.baselines.Matcher`.

        Raises:
            ImportError: the package is not installed.
            MatchError: fewer eigenfunctions than its functional map has.
        """
        given.check(x, y)
        package = _pyfm()
        steps = Steps()
        k_max = shared_size(x, y, self.k_max)
        if k_max < self.k:
            raise MatchError(f"k={self.k}: pyFM cannot make a map of {self.k} functions from {k_max} eigenfunctions")
        with steps("pyFM: descriptors"):
            first, second = (_pyfm_mesh(package, shape, k_max) for shape in (y, x))
            model = package.functional.FunctionalMapping(first, second)
            model.preprocess(
                n_descr=self.n_descriptors, k_process=k_max, k_descr=min(self.k_descriptors, k_max), descr_type="WKS"
            )
        with steps("pyFM: fit"):
            model.fit(K=(self.k, self.k))
        fmap = model.FM_12
        if self.icp:
            with steps("pyFM: ICP"):
                fmap = model.icp_refine(FM=fmap)
        n_steps = (k_max - self.k) // self.step
        if n_steps:
            with steps("pyFM: ZoomOut"):
                fmap = package.refine.mesh_zoomout_refine(
                    fmap, model.mesh1, model.mesh2, n_steps, self.step, subsample=self._samples(y, x)
                )
        with steps("pyFM: point map"):
            p2p = torch.from_numpy(np.asarray(model.get_p2p(FM=fmap)).astype(np.int64))
        return make_result(
            self.name,
            x,
            y,
            p2p,
            steps,
            notes=[f"pyfmaps {version('pyfmaps')}, eigenpairs of torchqm"],
            k=int(fmap.shape[0]),
        )

    def _samples(self, *shapes: PreparedShape) -> tuple[np.ndarray, ...] | None:
        """Vertices of pyFM's first and second mesh; chosen here, since pyFM starts from a random one each time."""
        n = self.n_samples
        if n is None:
            return None
        return tuple(
            farthest_points(s.mesh, min(n, int(s.mesh.referenced.sum())), method="euclidean").numpy() for s in shapes
        )


def _pyfm() -> ModuleType:
    """The package, with the modules that are used.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import pyFM
        import pyFM.functional
        import pyFM.mesh
        import pyFM.refine
    except ImportError as error:
        raise ImportError("pyfm: needs the package pyfmaps (pip install 'torchqm[benchmark]')") from error
    return pyFM


def _pyfm_mesh(package: ModuleType, shape: PreparedShape, k: int) -> Any:
    """A mesh of pyFM's with the eigenpairs of a prepared shape."""
    from scipy.sparse import diags_array

    verts, faces = shape.mesh.numpy()
    mesh = package.mesh.TriMesh(verts, faces)
    basis = shape.basis.truncate(k)
    mesh.mass = diags_array(basis.mass.numpy()).tocsc()
    mesh.eigenvalues, mesh.eigenvectors = basis.evals.numpy().copy(), basis.evecs.numpy().copy()
    return mesh
