"""Draw all built-in creatures in two poses each, with the colours carried over by the exact map: docs/creatures.png."""

import argparse
from pathlib import Path

from matplotlib.figure import Figure

from torchqm.data.synthetic import CREATURES, creature
from torchqm.geometry.files import write_whole
from torchqm.viz.render import View, render_mesh, xyz_colors

VIEWS = {
    "biped": View(elev=8, azim=30),
    "quadruped": View(elev=14, azim=52),
    "octopus": View(elev=38, azim=20),
    "ellipsoid": View(elev=48, azim=20),
    "asymmetric": View(elev=34, azim=25),
}
POSES = {"biped": (0, 4), "quadruped": (0, 3), "octopus": (0, 4), "ellipsoid": (0, 1), "asymmetric": (0, 2)}


def main() -> None:
    """Write the picture whole or not at all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "creatures.png")
    parser.add_argument("--n-verts", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--poses", type=int, nargs="*", help="other poses than the chosen ones, for all kinds")
    options = parser.parse_args()
    rows = len(options.poses or (0, 0))
    figure = Figure(figsize=(2.4 * len(CREATURES), 2.5 * rows), layout="constrained")
    figure.get_layout_engine().set(rect=(0, 0, 1, 0.94))
    axes = figure.subplots(rows, len(CREATURES), squeeze=False)
    for column, kind in enumerate(CREATURES):
        for row, pose in enumerate(options.poses or POSES[kind]):
            shape = creature(kind, options.n_verts, options.seed, pose)
            # One triangulation: vertex colours of the rest pose are the colours carried over by the exact map
            render_mesh(axes[row, column], shape.mesh, xyz_colors(shape.base), view=VIEWS[kind], up="y")
        label = "1 element" if len(shape.base_group) == 1 else f"{len(shape.base_group)} elements"
        figure.text((column + 0.5) / len(CREATURES), 0.99, f"{kind}, {label}", ha="center", va="top", fontsize=10)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(options.out, lambda file: figure.savefig(file, format="png", dpi=90))
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
