"""The octopus, the ellipsoid-like body and the crab: bodies with many mirror planes and with none."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchqm.data.creatures.limbs import chain, vary
from torchqm.data.creatures.skeleton import Chain, Skeleton, reflection_group

__all__ = ["asymmetric", "ellipsoid", "octopus"]


def octopus(rng: np.random.Generator) -> Skeleton:
    """A mantle and eight equal arms: the dihedral group of 16 elements."""
    length, thick, head, tall = (vary(rng, s) for s in (0.08, 0.06, 0.07, 0.08))
    mantle = chain(
        "mantle",
        [[0, 0.1, 0], [0, 0.22, 0], [0, 0.42 * tall, 0], [0, 0.62 * tall, 0]],
        [0.16, 0.135 * head, 0.2 * head, 0.16 * head],
        0.05,
    )
    radius = np.array([0.08, 0.24, 0.42, 0.6, 0.78, 0.96, 1.12]) * np.array([1] + [length] * 6)
    height = np.array([0.12, 0.1, 0.05, 0.03, 0.05, 0.09, 0.14])
    arm = chain(
        "arm_0",
        np.stack([radius, height, 0 * radius], 1),
        np.array([0.085, 0.078, 0.068, 0.058, 0.05, 0.043, 0.036]) * thick,
        0.03,
        "mantle",
        joints=[(1, 0.22), (2, 0.28), (3, 0.28), (4, 0.28), (5, 0.24)],
        orbit="arm",
    )
    arms = []
    for i in range(8):
        a = np.pi / 4 * i
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        arms.append(arm.image(turn, f"arm_{i}", "mantle"))
    s, c = np.sin(np.pi / 8), np.cos(np.pi / 8)
    return Skeleton("octopus", (mantle, *arms), np.array([[0, 0, 1.0], [s, 0, -c]]), 0.05)


def ellipsoid(rng: np.random.Generator) -> Skeleton:
    """A flat ellipsoid with fins, noses and humps: three mirror planes, eight elements."""
    long, wide, flat, bump, out = (vary(rng, s) for s in (0.05, 0.05, 0.06, 0.06, 0.05))
    body = chain(
        "body",
        [[-0.55 * long, 0, 0], [-0.25 * long, 0, 0], [0, 0, 0], [0.25 * long, 0, 0], [0.55 * long, 0, 0]],
        [0.27, 0.335, 0.35, 0.335, 0.27],
        0.04,
        joints=[(1, 0.5), (3, 0.5)],
        metric=(1, 0.85 / wide, 1.45 / flat),
    )
    group = reflection_group(np.eye(3))

    def images(name: str, nodes: list[Any], radii: list[Any], joints: Sequence[tuple[int, float]]) -> list[Chain]:
        first = chain(name, nodes, radii, 0.045, "body", joints, orbit=name)
        out_chains: list[Chain] = []
        for m in group:
            image = first.image(m, f"{name}_{len(out_chains)}", "body")
            if not any(np.allclose(image.nodes, c.nodes) for c in out_chains):
                out_chains.append(image)
        return out_chains

    fin = images(
        "fin",
        [[0.42 * long, 0.2, 0], [0.55 * long, 0.4 * out, 0], [0.64 * long, 0.56 * out, 0]],
        [0.11, 0.085 * bump, 0.07 * bump],
        [(1, 0.2)],
    )
    nose = images("nose", [[0.6 * long, 0, 0], [0.8 * long, 0, 0], [0.95 * long, 0, 0]], [0.14, 0.1, 0.085], [(1, 0.2)])
    hump = images("hump", [[0.24 * long, 0.1, 0.16], [0.27 * long, 0.11, 0.24]], [0.1, 0.075 * bump], [])
    side = images("side", [[0, 0.33, 0], [0, 0.46 * wide, 0]], [0.12, 0.075 * bump], [])
    return Skeleton("ellipsoid", (body, *fin, *nose, *hump, *side), np.eye(3), 0.05)


def asymmetric(rng: np.random.Generator) -> Skeleton:
    """A fiddler crab: one great claw, three legs on one side and two on the other."""
    size, thick, claw, leg, wide = (vary(rng, s) for s in (0.05, 0.06, 0.06, 0.06, 0.05))
    y = 0.34 * leg
    body = chain(
        "body",
        [
            [-0.3 * wide, y, -0.03],
            [-0.1 * wide, y + 0.02, 0.0],
            [0.14 * wide, y + 0.01, 0.02],
            [0.32 * wide, y - 0.01, 0.05],
        ],
        [0.17, 0.23, 0.22, 0.15],
        0.04,
        joints=(),
        metric=(1, 1.35, 1),
    )
    out = [body]
    # Walking legs: root on the body, knee, tip; unequal in number, length and thickness
    legs = [
        ("leg_a", (0.3, 0.16), (0.62, 0.2, 0.24), (0.85, 0.06, 0.3), 0.05),
        ("leg_b", (0.3, -0.04), (0.66, 0.26, -0.12), (0.98, 0.03, -0.16), 0.056),
        ("leg_c", (0.2, -0.16), (0.4, 0.2, -0.48), (0.52, 0.03, -0.78), 0.048),
        ("leg_d", (-0.28, -0.1), (-0.55, 0.2, -0.36), (-0.72, 0.03, -0.58), 0.06),
        ("leg_e", (-0.3, 0.06), (-0.52, 0.17, 0.1), (-0.68, 0.03, 0.13), 0.046),
    ]
    for name, root, knee, tip, r in legs:
        start = np.array([root[0] * wide, y, root[1]])
        bend = np.array([knee[0], y + knee[1], knee[2]])
        end = np.array([tip[0], tip[1], tip[2]])
        first = start + 0.35 * (bend - start) + [0, 0.02, 0]
        last = bend + 0.5 * (end - bend) + 0.06 * np.array([bend[0] - start[0], 0, bend[2] - start[2]])
        out.append(
            chain(
                name,
                [start, first, bend, last, end],
                np.array([1.25, 1.15, 1.0, 0.9, 0.72]) * r * thick,
                0.025,
                "body",
                joints=[(1, 0.16), (2, 0.18)],
            )
        )
    # One great claw on the creature's left, a small arm on its right
    out.append(
        chain(
            "claw",
            [[0.2, y + 0.02, 0.18], [0.36, y + 0.08, 0.36], [0.3, y + 0.14, 0.58], [0.16, y + 0.17, 0.7]],
            np.array([0.08, 0.075, 0.07, 0.085]) * claw,
            0.03,
            "body",
            joints=[(1, 0.18), (2, 0.2)],
        )
    )
    out.append(
        chain(
            "pincer_big",
            [[0.16, y + 0.17, 0.7], [0.03, y + 0.2, 0.8], [-0.12, y + 0.19, 0.86], [-0.27, y + 0.14, 0.84]],
            np.array([0.09, 0.12, 0.085, 0.045]) * claw,
            0.03,
            "claw",
            joints=(),
        )
    )
    out.append(
        chain(
            "pincer_thumb",
            [[0.05, y + 0.17, 0.76], [-0.07, y + 0.1, 0.72], [-0.2, y + 0.05, 0.68]],
            np.array([0.06, 0.05, 0.032]) * claw,
            0.02,
            "pincer_big",
            joints=(),
        )
    )
    out.append(
        chain(
            "arm",
            [[-0.2, y + 0.01, 0.14], [-0.34, y + 0.06, 0.3], [-0.36, y + 0.04, 0.45], [-0.3, y, 0.54]],
            np.array([0.06, 0.052, 0.05, 0.04]),
            0.025,
            "body",
            joints=[(1, 0.15), (2, 0.14)],
        )
    )
    # Eyes on stalks of different length and a stub of a tail turned to one side
    out.append(
        chain(
            "eye_a",
            [[0.1, y + 0.12, 0.15], [0.12, y + 0.27 * size, 0.2], [0.13, y + 0.36 * size, 0.22]],
            [0.045, 0.034, 0.055],
            0.015,
            "body",
            joints=[(1, 0.12)],
        )
    )
    out.append(chain("eye_b", [[-0.08, y + 0.12, 0.16], [-0.11, y + 0.2, 0.2]], [0.045, 0.062], 0.015, "body"))
    out.append(
        chain(
            "tail",
            [[-0.05, y, -0.18], [-0.12, y + 0.05, -0.34], [-0.26, y + 0.12, -0.46]],
            [0.1, 0.075, 0.045],
            0.03,
            "body",
            joints=[(1, 0.16)],
        )
    )
    return Skeleton("asymmetric", tuple(out), np.zeros((0, 3)), 0.03)
