"""The biped and the quadruped: bodies with one mirror plane."""

from dataclasses import replace

import numpy as np

from torchqm.data.creatures.limbs import chain, paired, vary
from torchqm.data.creatures.skeleton import Skeleton

__all__ = ["biped", "quadruped"]


def biped(rng: np.random.Generator) -> Skeleton:
    """A human-like body: nose and feet forward, flat hands with a thumb."""
    leg, arm, thick, head, wide, belly = (vary(rng, s) for s in (0.05, 0.05, 0.06, 0.06, 0.05, 0.08))
    hip = 0.86 * leg

    def up(*p: float) -> list[float]:
        return [p[0] * wide, hip + p[1], p[2]]

    def on_leg(*p: float) -> list[float]:
        return [p[0] * wide, p[1] * leg, p[2]]

    def on_arm(*p: float) -> list[float]:
        return up(0.15 + (p[0] - 0.15) * arm, 0.535 + (p[1] - 0.535) * arm, p[2])

    trunk = chain(
        "trunk",
        [up(0, 0.02, -0.01), up(0, 0.2, 0.005), up(0, 0.38, 0.0), up(0, 0.53, -0.015)],
        [0.112 * thick, 0.098 * thick * belly, 0.118 * thick, 0.07],
        0.02,
        joints=[(1, 0.3), (2, 0.25)],
        metric=(0.72, 1, 1),
    )
    neck = chain(
        "neck",
        [up(0, 0.5, -0.015), up(0, 0.6, -0.005), up(0, 0.7, 0.015)],
        [0.06, 0.052, 0.05],
        0.025,
        "trunk",
        joints=[(1, 0.12)],
    )
    skull = chain(
        "skull",
        [up(0, 0.73, 0.035), up(0, 0.78, 0.0)],
        [0.08 * head, 0.1 * head],
        0.02,
        "neck",
        metric=(1.12, 0.98, 1),
    )
    jaw = chain("jaw", [up(0, 0.69, 0.05), up(0, 0.665, 0.075)], [0.05 * head, 0.036 * head], 0.02, "skull")
    nose = chain("nose", [up(0, 0.765, 0.105), up(0, 0.73, 0.132 * head)], [0.014, 0.024], 0.012, "skull")
    ear = chain(
        "ear_l", [[0.093 * head, hip + 0.72, 0.01], [0.108 * head, hip + 0.765, 0.0]], [0.018, 0.026], 0.01, "skull"
    )
    arm_chain = chain(
        "arm_l",
        [
            up(0.06, 0.5, -0.01),
            up(0.155, 0.525, -0.015),
            on_arm(0.25, 0.43, -0.015),
            on_arm(0.375, 0.295, -0.02),
            on_arm(0.455, 0.205, 0.0),
            on_arm(0.545, 0.1, 0.03),
        ],
        [0.05, 0.066 * thick, 0.052 * thick, 0.041 * thick, 0.044 * thick, 0.029],
        0.03,
        "trunk",
        joints=[(1, 0.2), (3, 0.16), (5, 0.08)],
    )
    palm = chain(
        "palm_l",
        [on_arm(0.545, 0.1, 0.03), on_arm(0.59, 0.04, 0.045), on_arm(0.635, -0.035, 0.055)],
        [0.03, 0.048, 0.034],
        0.014,
        "arm_l",
        joints=[(1, 0.09)],
    )
    # Flat across the palm's normal, which is horizontal and at right angles to the arm
    across = np.array([0.72, 0.62, -0.3])
    across /= np.linalg.norm(across)
    palm = replace(palm, metric=np.eye(3) + 0.75 * np.outer(across, across))
    thumb = chain(
        "thumb_l",
        [on_arm(0.56, 0.065, 0.05), on_arm(0.568, 0.03, 0.1), on_arm(0.585, -0.005, 0.125)],
        [0.026, 0.022, 0.019],
        0.012,
        "palm_l",
    )
    leg_chain = chain(
        "leg_l",
        [
            up(0.075, 0.03, -0.01),
            on_leg(0.095, 0.82, -0.008),
            on_leg(0.105, 0.65, 0.005),
            on_leg(0.115, 0.465, 0.01),
            on_leg(0.12, 0.33, -0.015),
            on_leg(0.125, 0.09, -0.02),
        ],
        [0.085 * thick, 0.097 * thick, 0.08 * thick, 0.055 * thick, 0.056 * thick, 0.036],
        0.025,
        "trunk",
        joints=[(1, 0.26), (3, 0.18), (5, 0.09)],
    )
    foot = chain(
        "foot_l",
        [[0.125 * wide, 0.05, -0.045], [0.13 * wide, 0.04, 0.06], [0.14 * wide, 0.03, 0.15]],
        [0.042, 0.042, 0.032],
        0.025,
        "leg_l",
        metric=(0.85, 1, 1),
    )
    pairs = paired([ear, leg_chain, foot, arm_chain, palm, thumb])
    return Skeleton("biped", (trunk, neck, skull, jaw, nose, *pairs), np.array([[1.0, 0, 0]]), 0.04)


def quadruped(rng: np.random.Generator) -> Skeleton:
    """A dog-like body: four legs with paws, ears, snout and tail."""
    leg, length, thick, head, tail, neck_l = (vary(rng, s) for s in (0.07, 0.06, 0.06, 0.06, 0.1, 0.08))
    y = 0.62 * leg

    def p(x: float, up: float, z: float) -> list[float]:
        return [x, y + up, z * length]

    trunk = chain(
        "trunk",
        [p(0, 0.0, -0.42), p(0, 0.03, -0.18), p(0, 0.0, 0.1), p(0, 0.0, 0.34)],
        [0.13 * thick, 0.125 * thick, 0.15 * thick, 0.135 * thick],
        0.03,
        joints=[(1, 0.35), (2, 0.35)],
        metric=(1.1, 0.97, 1),
    )
    top = np.array(p(0, 0.3 * neck_l, 0.6))

    def head_at(*offset: float) -> np.ndarray:
        return top + offset

    neck = chain(
        "neck",
        [p(0, 0.05, 0.32), p(0, 0.17 * neck_l, 0.47), list(top)],
        [0.115, 0.092, 0.08],
        0.04,
        "trunk",
        joints=[(1, 0.25)],
    )
    skull = chain(
        "skull", [head_at(0, 0.03, 0.01), head_at(0, 0.035, 0.07)], [0.092 * head, 0.095 * head], 0.02, "neck"
    )
    snout = chain(
        "snout",
        [head_at(0, 0.015, 0.1), head_at(0, -0.02, 0.2 * head), head_at(0, -0.03, 0.26 * head)],
        [0.07 * head, 0.052 * head, 0.046 * head],
        0.02,
        "skull",
        metric=(0.95, 1, 1),
    )
    ear = chain(
        "ear_l",
        [
            head_at(0.05 * head, 0.09 * head, 0.0),
            head_at(0.085 * head, 0.165 * head, -0.015),
            head_at(0.1 * head, 0.22 * head, -0.02),
        ],
        [0.04, 0.037, 0.02],
        0.014,
        "skull",
        metric=(1, 1, 1.35),
    )
    tail_c = chain(
        "tail",
        [p(0, 0.03, -0.42), p(0, 0.07, -0.56), p(0, 0.05, -0.7), p(0, -0.03, -0.83 * tail), p(0, -0.07, -0.98 * tail)],
        [0.06, 0.044, 0.035, 0.032, 0.03],
        0.025,
        "trunk",
        joints=[(1, 0.2), (2, 0.25), (3, 0.25)],
    )
    front = chain(
        "fore_l",
        [
            p(0.075, -0.02, 0.28),
            p(0.105, -0.13, 0.29),
            [0.11, 0.31 * leg, 0.27 * length],
            [0.11, 0.09 * leg, 0.285 * length],
        ],
        [0.085 * thick, 0.085 * thick, 0.053, 0.04],
        0.03,
        "trunk",
        joints=[(1, 0.2), (2, 0.16), (3, 0.1)],
    )
    paw_f = chain(
        "forepaw_l",
        [[0.11, 0.055, 0.285 * length], [0.112, 0.045, 0.285 * length + 0.07]],
        [0.046, 0.046],
        0.02,
        "fore_l",
        metric=(0.9, 1, 1),
    )
    hind = chain(
        "hind_l",
        [
            p(0.075, -0.01, -0.38),
            p(0.1, -0.13, -0.36),
            [0.112, 0.32 * leg, -0.36 * length - 0.03],
            [0.112, 0.09 * leg, -0.4 * length],
        ],
        [0.095 * thick, 0.1 * thick, 0.056, 0.04],
        0.03,
        "trunk",
        joints=[(1, 0.22), (2, 0.16), (3, 0.1)],
    )
    paw_h = chain(
        "hindpaw_l",
        [[0.112, 0.055, -0.4 * length], [0.114, 0.045, -0.4 * length + 0.08]],
        [0.046, 0.046],
        0.02,
        "hind_l",
        metric=(0.9, 1, 1),
    )
    pairs = paired([ear, front, paw_f, hind, paw_h])
    return Skeleton("quadruped", (trunk, neck, skull, snout, tail_c, *pairs), np.array([[1.0, 0, 0]]), 0.045)
