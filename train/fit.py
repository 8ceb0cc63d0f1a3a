"""Train a matcher: python train/fit.py --config configs/experiment/quick.yaml [--model.lr 1e-3 ...]."""

import sys

from torchqm.cli.learn import fit

if __name__ == "__main__":
    fit(sys.argv[1:])
