"""All layers, given batches at the edge of what makes sense; run by tests/nn/test_degenerate.py without type checks.

Writes what each returned (its tensors) or raised, by case and layer, to the file that it is given.
"""

import sys
import warnings

import torch

from torchqm.nn import (
    MLP,
    DiffusionNet,
    FunctionalMapLoss,
    FunctionalMapSolver,
    HeatKernelSignature,
    InputFeatures,
    OrbitConsistencyLoss,
    OrientationDescriptors,
    PointToOrbitLoss,
    QuotientICP,
    Similarity,
    SoftPointMap,
    SpectralUpsampling,
    SymmetrizedBasis,
    WaveKernelSignature,
)

BASIS, MASKS = ("evals", "evecs", "mass"), ("vmask", "kmask")


def given(b=2, v=7, k=4):
    """A shape and itself: equal features, the identity as map and truth, a flip as symmetry."""
    g = torch.Generator().manual_seed(0)
    start = torch.randn(2, v, max(k, 1), generator=g)
    start[..., 0] = 1.0
    g.manual_seed(1)  # the rest is the same for any k
    q = torch.linalg.qr(start).Q[..., :k] * v**0.5
    q = q * torch.where(q[:, :1] < 0, -1.0, 1.0)
    ids = torch.arange(v)
    d = {
        "evals": 12.0 * torch.arange(k).expand(2, k),
        "evecs": q,
        "mass": torch.full((2, v), 1 / v),
        "feat": torch.randn(2, v, 6, generator=g),
        "evecs_trans": q.mT / v,
        "group": torch.stack([ids, ids.flip(0)]).expand(2, 2, v),
        "faces": torch.stack([ids, ids.roll(1), ids.roll(2)], -1).expand(2, v, 3),
        "truth": ids.expand(2, v),
        "soft": torch.full((2, v, v), 1 / v),
        "dist": (ids - ids[:, None]).abs().float().expand(2, v, v),
        "fmap": torch.eye(k).expand(2, k, k),
        "verts": torch.randn(2, v, 3, generator=g),
        "vmask": torch.ones(2, v, dtype=torch.bool),
        "kmask": torch.ones(2, k, dtype=torch.bool),
        "gmask": torch.ones(2, 2, dtype=torch.bool),
    }
    return {name: tensor[:b].contiguous() for name, tensor in d.items()}


def orbit(form, **named):
    loss = PointToOrbitLoss(form)
    return lambda d: loss(d["truth"], d["mass"], truth_mask=d["vmask"], **{n: d[key] for n, key in named.items()})


def many(d):
    return d["fmap"][:, None].expand(-1, 2, -1, -1)


GROUP = {"soft_xy": "soft", "group_y": "group", "group_mask": "gmask"}
ICP = ("fmap", "evecs", "evecs", "mass", "vmask", "kmask", "kmask")
CALLS = {  # layer: what it reads, its call
    "SymmetrizedBasis": (
        (*BASIS, *MASKS, "group", "gmask"),
        lambda d: SymmetrizedBasis()(
            *(d[n] for n in BASIS),
            group=d["group"],
            group_mask=d["gmask"],
            verts_mask=d["vmask"],
            evals_mask=d["kmask"],
        ),
    ),
    "SymmetrizedBasis.soft": (
        (*BASIS, *MASKS, "soft"),
        lambda d: SymmetrizedBasis()(
            *(d[n] for n in BASIS), soft_map=d["soft"], verts_mask=d["vmask"], evals_mask=d["kmask"]
        ),
    ),
    "SymmetrizedBasis.projector": (
        ("evecs", "mass", "fmap"),
        lambda d: SymmetrizedBasis().projector(d["evecs"], d["mass"], fmaps=d["fmap"]),
    ),
    "SymmetrizedBasis.parts": (
        ("evecs", "mass", "fmap", "feat"),
        lambda d: SymmetrizedBasis().parts(d["feat"][:, : d["fmap"].shape[-1]], d["evecs"], d["mass"], fmaps=d["fmap"]),
    ),
    "WaveKernelSignature": (
        (*BASIS, "kmask"),
        lambda d: WaveKernelSignature(5, 6)(*(d[n] for n in BASIS), d["kmask"]),
    ),
    "HeatKernelSignature": (
        (*BASIS, "kmask"),
        lambda d: HeatKernelSignature(5, 6)(*(d[n] for n in BASIS), d["kmask"]),
    ),
    "OrientationDescriptors": (
        ("feat", "faces", "mass"),
        lambda d: OrientationDescriptors(6)(d["feat"], d["faces"], d["mass"]),
    ),
    "DiffusionNet": (
        (*BASIS, "feat", "vmask"),
        lambda d: DiffusionNet(6, 3, 4, 1, with_gradient_features=False)(
            d["feat"], d["mass"], evals=d["evals"], evecs=d["evecs"], verts_mask=d["vmask"]
        ),
    ),
    "DiffusionNet.mean": (
        (*BASIS, "feat", "vmask"),
        lambda d: DiffusionNet(6, 3, 4, 1, with_gradient_features=False, outputs_at="global_mean")(
            d["feat"], d["mass"], evals=d["evals"], evecs=d["evecs"], verts_mask=d["vmask"]
        ),
    ),
    "InputFeatures": (
        (*BASIS, *MASKS, "verts"),
        lambda d: InputFeatures(("xyz", "hks"), 5, 6)(d | {"verts_mask": d["vmask"], "evals_mask": d["kmask"]}),
    ),
    "MLP": (("feat", "vmask"), lambda d: MLP(6, 3)(d["feat"], d["vmask"])),
    "Similarity": (("feat",), lambda d: Similarity()(d["feat"])),
    "Similarity.hard": (("feat",), lambda d: Similarity(hard=True)(d["feat"])),
    "SoftPointMap": (("feat", "vmask"), lambda d: SoftPointMap()(d["feat"], d["feat"], d["vmask"], d["vmask"])),
    "SoftPointMap.k": (
        ("feat", "vmask"),
        lambda d: SoftPointMap(k=1, kind="distance", normalize=True)(d["feat"], d["feat"], d["vmask"], d["vmask"]),
    ),
    "FunctionalMapSolver": (
        ("feat", "evals", "evecs_trans", "kmask"),
        lambda d: FunctionalMapSolver(bidirectional=True)(
            *(d[n] for n in ("feat", "feat", "evals", "evals", "evecs_trans", "evecs_trans")),
            evals_mask_x=d["kmask"],
            evals_mask_y=d["kmask"],
        ),
    ),
    "FunctionalMapSolver.odd": (
        ("feat", "evals", "evecs_trans", "kmask"),
        lambda d: FunctionalMapSolver(ridge=0.1)(
            *(d[n] for n in ("feat", "feat", "evals", "evals", "evecs_trans", "evecs_trans")),
            **{f"evals_odd_{side}": d["evals"] for side in "xy"},
            **{f"evecs_trans_odd_{side}": d["evecs_trans"] for side in "xy"},
            **{f"evals_odd_mask_{side}": d["kmask"] for side in "xy"},
        ),
    ),
    "QuotientICP": (ICP, lambda d: QuotientICP(2, 1e-3)(*(d[n] for n in ICP))),
    "SpectralUpsampling": (
        ICP,
        lambda d: SpectralUpsampling((1, d["fmap"].shape[-1]), 2, 1e-3, neighbours=1)(*(d[n] for n in ICP)),
    ),
    "PointToOrbitLoss.spectral": (
        ("truth", "mass", "vmask", "fmap", "evecs"),
        orbit("spectral", fmap_even="fmap", evecs_even_x="evecs", evecs_even_y="evecs"),
    ),
    "PointToOrbitLoss.assignment": (
        ("truth", "mass", "vmask", "soft", "group", "gmask"),
        orbit("assignment", **GROUP),
    ),
    "PointToOrbitLoss.distance": (
        ("truth", "mass", "vmask", "soft", "group", "gmask", "dist"),
        orbit("distance", dist_y="dist", **GROUP),
    ),
    "PointToOrbitLoss.map": (
        ("truth", "mass", "vmask", "soft", "group", "gmask", "dist"),
        orbit("map", dist_y="dist", **GROUP),
    ),
    "FunctionalMapLoss": (
        ("fmap", "evals", "kmask"),
        lambda d: FunctionalMapLoss()(*(d[n] for n in ("fmap", "fmap", "evals", "evals", "kmask", "kmask"))),
    ),
    "OrbitConsistencyLoss": (
        ("fmap", "gmask"),
        lambda d: OrbitConsistencyLoss()(d["fmap"], many(d), many(d), group_mask=d["gmask"]),
    ),
    "OrbitConsistencyLoss.points": (
        ("soft", "group", "feat", "mass", "gmask"),
        lambda d: OrbitConsistencyLoss("points")(
            d["soft"], d["group"], d["group"], values_y=d["feat"], mass_x=d["mass"], group_mask=d["gmask"]
        ),
    ),
}
IN_BASIS = ("evals", "evecs", "mass", "evecs_trans")
INTEGER = (*IN_BASIS, "feat", "fmap", "soft", "dist", "verts")
CHANGES = {  # case: what is changed, and how
    "mask of vertices all false": (("vmask",), lambda t: ~t),
    "mask of functions all false": (("kmask",), lambda t: ~t),
    "mask of elements all false": (("gmask",), lambda t: ~t),
    "NaN features": (("feat",), lambda t: t * torch.nan),
    "NaN eigenvalues": (("evals",), lambda t: t * torch.nan),
    "NaN functions": (("evecs", "evecs_trans"), lambda t: t * torch.nan),
    "NaN areas": (("mass",), lambda t: t * torch.nan),
    "NaN maps": (("fmap", "soft"), lambda t: t * torch.nan),
    "no area": (("mass",), lambda t: t * 0),
    "basis in float64": (IN_BASIS, lambda t: t.double()),
    "integer masks": (("vmask", "kmask", "gmask"), lambda t: t.long()),
    "short ids": (("truth", "group", "faces"), lambda t: t.int()),
    **{f"integer {name}": ((name,), lambda t: torch.ones_like(t).long()) for name in INTEGER},
    "integers everywhere": (INTEGER, lambda t: torch.ones_like(t).long()),
}
SIZES = {"as usual": {}, "no shape": {"b": 0}, "one function": {"k": 1}, "one vertex": {"v": 1, "k": 1}}


def cases():
    for case, sizes in SIZES.items():
        yield case, given(**sizes)
    for case, (names, change) in CHANGES.items():
        d = given()
        yield case, d | {name: change(d[name]) for name in names}


def tensors(result):
    if isinstance(result, torch.Tensor):
        return [result.detach()]
    if result is None:
        return []
    if isinstance(result, (tuple, list)):
        return [tensor for part in result for tensor in tensors(part)]
    return (
        tensors(list((result if isinstance(result, dict) else vars(result)).values()))
        if not isinstance(result, (int, float))
        else []
    )


def main(path):
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    found = {}
    for case, d in cases():
        for layer, (_, call) in CALLS.items():
            torch.manual_seed(0)
            try:
                found[case, layer] = tensors(call(d))
            except Exception as error:
                found[case, layer] = isinstance(error, ValueError), f"{type(error).__name__}: {error}", str(error)
    torch.save(found, path)


if __name__ == "__main__":
    main(sys.argv[1])
