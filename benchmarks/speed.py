"""Seconds and memory: eigenpairs, a whole pair of meshes, how both grow to a million vertices, and geodesics.

    python benchmarks/speed.py eigenpairs [--scb ROOT] [--sizes 5000 28000 52000] [--k 100 200 300] [--repeats 5]
    python benchmarks/speed.py pair       [--scb ROOT] [--repeats 5]
    python benchmarks/speed.py growth     [--sizes 1000 4000 ...]
    python benchmarks/speed.py geodesics  [--scb ROOT] [--sizes 1000 28000 52000 250000] [--repeats 5]

Peers run in the same process and take turns with torchqm; reported are medians and ratios. Peak memory is that of a
process of its own for each. With --scb the meshes of 28k and 52k vertices are TOSCA's cat1 and michael1, else built-in
quadrupeds. Writes benchmarks/results/speed_*.json.
"""

import argparse
from pathlib import Path

import speed_eigen
import speed_geodesic
import speed_growth
import speed_match
import torch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("eigenpairs", "pair", "growth", "geodesics"))
    parser.add_argument("--scb", type=Path, help="root of TOSCA as SCB ships it")
    parser.add_argument("--sizes", type=int, nargs="+")
    parser.add_argument("--k", type=int, nargs="+", default=[100, 200, 300])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.part == "eigenpairs":
        speed_eigen.measure(args.sizes or [5000, 28000, 52000], args.k, args.repeats, args.scb)
    elif args.part == "pair":
        speed_match.measure(args.repeats, args.scb)
    elif args.part == "geodesics":
        speed_geodesic.measure(args.sizes or [1000, 28000, 52000, 250000], args.repeats, args.scb)
    else:
        speed_growth.measure(args.sizes or [1000, 4000, 16000, 64000, 250000, 1000000])


if __name__ == "__main__":
    main()
