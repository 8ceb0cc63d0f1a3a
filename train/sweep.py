"""Train over seeds and set-ups: python train/sweep.py configs/sweep/swapped.yaml --out runs/swapped."""

import sys

from torchqm.cli.sweep import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
