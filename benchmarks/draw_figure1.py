"""The paper's Figure 1 from built-in shapes: all the equally good maps between two octopuses. Writes docs/octopus.png.

    python benchmarks/draw_figure1.py [--n-verts 8000] [--poses 3 4]

Both octopuses are in a pose and have triangulations of their own; nothing is told to the matcher. The colours of the
target are carried over by each map. Prints the mean error of each map against the exact truth it is nearest to, and how
many of the true maps are among them.
"""

import argparse
from pathlib import Path

from common import DOCS

from torchqm import creature, exact_maps, match
from torchqm.viz import match_figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-verts", type=int, default=8000)
    parser.add_argument("--poses", type=int, nargs=2, default=(3, 4))
    parser.add_argument("--out", type=Path, default=DOCS / "octopus.png")
    options = parser.parse_args()
    source = creature("octopus", options.n_verts, 0, options.poses[0], retriangulate=1)
    target = creature("octopus", options.n_verts, 0, options.poses[1], retriangulate=2)
    result = match(source.mesh, target.mesh)
    truth = exact_maps(source, target).points(target.mesh)
    size = target.mesh.area**0.5
    found = set()
    for label, score, p2p in zip(result.labels, result.scores, result.maps, strict=True):
        gaps = (target.mesh.verts[p2p] - truth).norm(dim=2).mean(1) / size
        found.add(int(gaps.argmin()))
        print(f"{label:9} score {float(score):.3f}  error {float(gaps.min()):.4f} of sqrt(area)")
    print(f"{len(found)} of {len(truth)} true maps; warnings: {result.warnings or 'none'}")
    print({name: round(seconds, 1) for name, seconds in result.seconds.items()})
    match_figure(source.mesh, target.mesh, result.maps, result.labels, options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
