"""The network that ships: small, says how it was made, and tells more than the features that it is given."""

import json
import subprocess
import sys
from dataclasses import replace

import torch
from safetensors import safe_open

from torchqm.data import ItemOptions, PairDataset, collate, open_shapes
from torchqm.learn import MatchNet, load_net
from torchqm.learn.checkpoints import find_weights


def test_it_is_small_and_says_how_it_was_made():
    path = find_weights("builtin")
    assert path.stat().st_size < 5e6
    with safe_open(path, "pt") as file:
        about = json.loads(file.metadata()["torchqm"])["about"]
    assert about["config"]["data"]["root"].startswith("synthetic:")
    assert about["config"]["seed_everything"] == 0
    assert set(about["versions"]) >= {"torchqm", "torch", "python"}


def test_it_is_used_without_lightning():
    """Whoever only matches needs none of the extra ``learn``."""
    script = """
import sys
for name in ("pytorch_lightning", "lightning", "jsonargparse"):
    sys.modules[name] = None  # an import of it is an ImportError
from torchqm.cli.checkpoint import read_checkpoint
print(read_checkpoint("builtin"))
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.startswith("LearnedDescriptors(")


def test_it_beats_wave_kernel_signatures_in_the_same_solver():
    """On a body, poses and triangulations that it was not trained on; plain errors, as left must stay left."""
    net = load_net("builtin")
    wks = MatchNet(replace(net.options, network="none")).eval()
    shapes = open_shapes("synthetic:kinds=quadruped;poses=2;verts=700;seed=11")
    options = ItemOptions(keys=(*net.options.keys, "corr"), k=net.options.k, dtype=torch.float32)
    batch = collate([PairDataset(shapes, "within-class+unordered", options=options)[0]])
    with torch.no_grad():
        learned, given = (one.errors(batch, one(batch["first"], batch["second"])) for one in (net, wks))
    for name in ("plain_error", "orbit_error"):
        assert float(learned[name]) < float(given[name]), name
    assert float(learned["flipped_map"]) == 0
