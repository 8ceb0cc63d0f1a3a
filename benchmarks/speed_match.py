"""A whole pair, from two mesh files to both dense maps: torchqm, with and without kept eigenpairs, against pyFM."""

import contextlib
import io
import os
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from common import RESULTS, peak_mib, write_json

from torchqm import match
from torchqm.data.synthetic import creature
from torchqm.evaluate import evaluate_map
from torchqm.geometry import Mesh, farthest_points, load_mesh, save_mesh

Matcher = Callable[[Path, Path, Path], np.ndarray]
POINTS = 500


def ours(source: Path, target: Path, cache: Path) -> np.ndarray:
    """``torchqm.match`` with its defaults, nothing kept."""
    return match(source, target).maps[0].numpy()


def ours_cached(source: Path, target: Path, cache: Path) -> np.ndarray:
    """The same with the eigenpairs of both shapes in a cache."""
    return match(source, target, cache_dir=cache).maps[0].numpy()


def pyfm_icp(source: Path, target: Path, cache: Path) -> np.ndarray:
    """pyFM as its documentation begins: WKS, fit, ICP, 50 x 50."""
    return _pyfm(source, target, zoomout=False)


def pyfm_zoomout(source: Path, target: Path, cache: Path) -> np.ndarray:
    """pyFM: WKS, fit, ZoomOut from 50 to 200 on 3,000 points."""
    return _pyfm(source, target, zoomout=True)


METHODS: dict[str, Matcher] = {
    "torchqm": ours,
    "torchqm, eigenpairs kept": ours_cached,
    "pyFM WKS + ICP": pyfm_icp,
    "pyFM WKS + ZoomOut 200": pyfm_zoomout,
}


def _pyfm(source: Path, target: Path, zoomout: bool) -> np.ndarray:
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    with contextlib.redirect_stdout(io.StringIO()):
        # It maps the vertices of its second mesh to its first.
        meshes = [TriMesh(str(path), area_normalize=True, center=False) for path in (target, source)]
        model = FunctionalMapping(*meshes)
        model.preprocess(n_descr=100, k_process=200, k_descr=128, descr_type="WKS")
        model.fit(K=(50, 50))
        fmap = model.zoomout_refine(nit=30, step=5, subsample=3000) if zoomout else model.icp_refine()
        return np.asarray(model.get_p2p(FM=fmap if fmap is not None else model.FM))


def _pyfm_loaded() -> None:
    """Its modules, so that no turn pays for them; torchqm's are loaded, too, by then."""
    import pyFM.functional
    import pyFM.mesh
    import pyFM.refine  # noqa: F401


def pair_of(scb: Path | None) -> tuple[Mesh, Mesh, torch.Tensor, torch.Tensor]:
    """Source, target, points of the source, and where they belong."""
    if scb is not None:
        source, target = (load_mesh(scb / "TOSCA" / "Meshes" / f"{name}.off") for name in ("cat1", "cat0"))
    else:
        source, target = (creature("quadruped", 28000, 0, pose).mesh for pose in (1, 0))
    at = farthest_points(source, POINTS, method="euclidean")
    return source, target, at, at  # poses of one body share their vertices


def measure(repeats: int, scb: Path | None) -> None:
    """Every method, in turn; the peers less often, since they take minutes."""
    os.environ.pop("TORCHQM_CACHE", None)
    source, target, at, truth = pair_of(scb)
    seconds: dict[str, list[float]] = {name: [] for name in METHODS}
    errors: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        files = [Path(folder) / f"{mesh.name}.off" for mesh in (source, target)]
        for mesh, path in zip((source, target), files, strict=True):
            save_mesh(mesh, path)
        ours_cached(*files, cache)
        _pyfm_loaded()
        for turn in range(repeats):
            for name, method in METHODS.items():
                if name.startswith("pyFM") and turn >= 2:  # minutes each
                    continue
                begin = perf_counter()
                found = torch.from_numpy(np.asarray(method(*files, cache)).astype(np.int64))
                seconds[name].append(perf_counter() - begin)
                result = evaluate_map(target.normalized(), found, truth, at)
                errors[name] = {"plain": result.reports["plain"].mean}
                print(name, f"{seconds[name][-1]:.2f} s", errors[name], flush=True)
        peaks = {name: peak_mib(method, *files, cache) for name, method in METHODS.items()}
    middle = {name: statistics.median(values) for name, values in seconds.items()}
    rows = {
        name: {
            "seconds": middle[name],
            "all_seconds": seconds[name],
            "times_torchqm": middle[name] / middle["torchqm"],
            **errors[name],
            "peak_mib": peaks[name],
        }
        for name in METHODS
    }
    vertices = [source.n_verts, target.n_verts]
    result = {"pair": [source.name, target.name], "vertices": vertices, "points": POINTS, "repeats": repeats}
    write_json(RESULTS / "speed_match.json", {**result, "threads": torch.get_num_threads(), "methods": rows})


__all__ = ["measure"]
