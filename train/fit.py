"""Train a matcher: python train/fit.py --config configs/experiment/quick.yaml [--model.lr 1e-3 ...]."""

import sys

from torchqm.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["fit", *sys.argv[1:]]))
