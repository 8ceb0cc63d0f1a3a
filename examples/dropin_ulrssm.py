"""An unsupervised pipeline with the dictionary keys and calls of the ULRSSM family, and the two lines that change.

python examples/dropin_ulrssm.py

Features come from intrinsic descriptors, so left and right look the same. In the full basis the functional map must
guess between the two maps and mixes them; in the even basis there is nothing to guess.
"""

import torch

from torchqm.data import ItemOptions, PairDataset, collate, open_shapes
from torchqm.nn import FunctionalMapLoss, FunctionalMapSolver, Similarity, SymmetrizedBasis, WaveKernelSignature


class Extractor(torch.nn.Module):
    """Stands for the feature network of the pipeline: an MLP on wave kernel signatures."""

    def __init__(self, k, channels=64):
        super().__init__()
        self.signature = WaveKernelSignature(n=96, k=k)
        self.mlp = torch.nn.Sequential(torch.nn.Linear(96, 128), torch.nn.ReLU(), torch.nn.Linear(128, channels))

    def forward(self, data):
        return self.mlp(self.signature(data["evals"], data["evecs"], data["mass"]))


def even(data):
    """The same item with the basis of its symmetric functions in place of the full one."""
    masks = {name: data[name] for name in ("group_mask", "evals_mask", "verts_mask")}  # of a padded batch
    split = SymmetrizedBasis()(data["evals"], data["evecs"], data["mass"], group=data["group"], **masks)
    return data | {"evals": split.evals_even, "evecs": split.evecs_even, "evecs_trans": split.evecs_trans_even}


def train(quotient_aware, batch, k, steps=15):
    """The usual loop; returns functional and point maps of the trained network."""
    torch.manual_seed(0)
    extractor = Extractor(k).double()
    permutation, criterion = Similarity(tau=0.07), FunctionalMapLoss(w_bij=1.0, w_orth=1.0, w_lap=1e-3)
    optimizer = torch.optim.Adam(extractor.parameters(), 1e-3)
    fmap_net = FunctionalMapSolver(lmbda=100, resolvant_gamma=0.5, bidirectional=True)  # was: RegularizedFMNet(...)
    change_basis = even if quotient_aware else dict  # was: nothing
    for _ in range(steps):
        feat_x, feat_y = (torch.nn.functional.normalize(extractor(batch[side]), dim=-1) for side in ("first", "second"))
        data_x, data_y = change_basis(batch["first"]), change_basis(batch["second"])
        c_xy, c_yx = fmap_net(
            *(feat_x, feat_y, data_x["evals"], data_y["evals"], data_x["evecs_trans"], data_y["evecs_trans"])
        )
        p_yx = permutation(feat_y @ feat_x.mT)
        align = (c_xy - data_y["evecs_trans"] @ (p_yx @ data_x["evecs"])).square().sum((1, 2)).mean()
        loss = align + sum(criterion(c_xy, c_yx, data_x["evals"], data_y["evals"]).values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    images = data_x["evecs"][0] @ c_xy[0].detach().T  # each vertex of x as a function on y
    return torch.cdist(images, data_y["evecs"][0]).argmin(1)


def main():
    """Train both ways on one pair; distance of each vertex's image from its true orbit."""
    k = 40
    shapes = open_shapes("synthetic:kinds=quadruped;poses=2;verts=1000;triangulation=shared")
    options = ItemOptions(keys=("mass", "basis", "symmetry"), k=k)
    batch = collate([PairDataset(shapes, "within-class", options=options)[0]])
    y = batch["second"]
    verts, orbits = y["verts"][0], y["group"][0].T
    for quotient_aware in (False, True):
        p2p = train(quotient_aware, batch, k)
        error = (verts[orbits[p2p]] - verts[:, None]).norm(dim=2).amin(1).mean() / y["mass"].sum().sqrt()
        print(f"{'even' if quotient_aware else 'full'} basis: mean distance from the orbit {error:.4f} sqrt(area)")


if __name__ == "__main__":
    main()
