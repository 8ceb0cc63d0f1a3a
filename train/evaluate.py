"""Test a trained matcher: python train/evaluate.py RUN [--data.test_root ...]; as `torchqm test`."""

import sys

from torchqm.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["test", *sys.argv[1:]]))
