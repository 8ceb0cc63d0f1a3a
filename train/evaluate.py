"""Test a trained matcher: python train/evaluate.py RUN [--data.test_root ...], RUN the folder of a training."""

import sys

from torchqm.cli.learn import evaluate

if __name__ == "__main__":
    evaluate(sys.argv[1:])
