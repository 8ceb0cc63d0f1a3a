"""Natural joint angles of each kind, drawn by the pose's seed."""

from collections.abc import Callable

import numpy as np

__all__ = ["draw_pose"]

_X, _Y, _Z = np.eye(3)


class _Dice:
    """Angles in degrees between two bounds."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def __call__(self, low: float, high: float) -> float:
        return float(np.radians(self.rng.uniform(low, high)))


def _mirrored(rows: list[np.ndarray], side: str) -> np.ndarray:
    """Rotation vectors written for the left side, for the given side (a reflection in x keeps the x part only)."""
    return np.stack(rows) * (np.array([1.0, -1.0, -1.0]) if side == "r" else 1.0)


def _biped(u: _Dice) -> dict[str, np.ndarray]:
    out = {
        "trunk": np.stack(
            [
                u(-4, 14) * _X + u(-10, 10) * _Y + u(-8, 8) * _Z,
                u(-2, 10) * _X + u(-12, 12) * _Y + u(-6, 6) * _Z,
                u(-30, 30) * _Y,
            ]
        ),
        "neck": np.stack([u(-12, 12) * _X + u(-28, 28) * _Y + u(-8, 8) * _Z]),
    }
    stride = u(-24, 24)
    for side, sign in (("l", 1), ("r", -1)):
        thigh = -sign * stride + u(-22, 4)
        knee = u(6, 38) + max(0.0, sign * stride)
        out[f"leg_{side}"] = _mirrored(
            [thigh * _X + u(-2, 12) * _Z, knee * _X, u(-8, 8) * _X - 0.4 * (thigh + knee) * _X], side
        )
        swing = sign * stride * 1.1
        out[f"arm_{side}"] = _mirrored(
            [
                (swing - u(-10, 45)) * _X + u(-12, 40) * _Z + u(-20, 5) * _Y,
                -u(8, 65) * _Y - u(0, 30) * _X,
                u(-12, 12) * _Z,
            ],
            side,
        )
        out[f"palm_{side}"] = _mirrored([u(-5, 20) * (-0.6 * _Z)], side)
    return out


def _quadruped(u: _Dice) -> dict[str, np.ndarray]:
    turn = u(-14, 14)
    out = {
        "trunk": np.stack([turn * _Y + u(-6, 8) * _X, turn * _Y + u(-8, 4) * _X, u(-30, 30) * _Y]),
        "neck": np.stack([u(-25, 30) * _X + u(-30, 30) * _Y]),
        "tail": np.stack(
            [u(-25, 30) * _X + u(-25, 25) * _Y, u(-15, 30) * _X + u(-30, 30) * _Y, u(-10, 30) * _X + u(-30, 30) * _Y]
        ),
    }
    step = u(8, 26) * (1 if u(-1, 1) > 0 else -1)
    for side, sign in (("l", 1), ("r", -1)):
        for name, phase in (("fore", sign), ("hind", -sign)):
            hip = phase * step + u(-8, 8)
            bend = u(4, 30) if name == "hind" else -u(0, 28)
            bend += (0.5 if name == "hind" else -0.5) * max(0.0, phase * step)
            out[f"{name}_{side}"] = _mirrored(
                [hip * _X + u(-2, 8) * _Z, -bend * _X if name == "fore" else bend * _X, 0.6 * (-hip) * _X], side
            )
    return out


def _octopus(u: _Dice) -> dict[str, np.ndarray]:
    out = {"mantle": np.stack([u(-15, 15) * _X + u(-15, 15) * _Z])}
    curl, lift = u(-22, 22), u(-6, 18)
    for i in range(8):
        a = np.pi / 4 * i
        side = np.array([-np.sin(a), 0.0, -np.cos(a)])
        rows = []
        for j in range(5):
            up = (lift if j < 2 else -0.5 * lift) + u(-14, 22)
            rows.append((curl + u(-24, 24)) * _Y + up * -side)
        out[f"arm_{i}"] = np.stack(rows)
    return out


def _ellipsoid(u: _Dice) -> dict[str, np.ndarray]:
    out = {
        "body": np.stack([u(6, 20) * _Y + u(-5, 5) * _Z + u(-7, 7) * _X, u(6, 20) * _Y + u(-5, 5) * _Z + u(-7, 7) * _X])
    }
    for name, number in (("fin", 4), ("nose", 2)):
        for i in range(number):
            out[f"{name}_{i}"] = np.stack([u(-30, 30) * _Z + u(-25, 25) * _Y + u(-25, 25) * _X])
    return out


def _asymmetric(u: _Dice) -> dict[str, np.ndarray]:
    out = {}
    for name in ("leg_a", "leg_b", "leg_c", "leg_d", "leg_e"):
        lift = u(-14, 16) * (1 if name < "leg_d" else -1)
        across = _Z if name != "leg_c" else _X
        out[name] = np.stack([u(-24, 24) * _Y + lift * across, u(-16, 16) * _Y - lift * across])
    out["claw"] = np.stack([u(-20, 12) * _Y + u(-20, 12) * _X, u(-20, 20) * _Y + u(-20, 10) * _X])
    out["arm"] = np.stack([u(-15, 25) * _Y + u(-25, 15) * _X, u(-25, 25) * _Y + u(-20, 20) * _X])
    out["eye_a"] = np.stack([u(-20, 20) * _X + u(-20, 20) * _Z])
    out["tail"] = np.stack([u(-20, 20) * _Y + u(-15, 20) * _X])
    return out


_KINDS: dict[str, Callable[[_Dice], dict[str, np.ndarray]]] = {
    "biped": _biped,
    "quadruped": _quadruped,
    "octopus": _octopus,
    "ellipsoid": _ellipsoid,
    "asymmetric": _asymmetric,
}


def draw_pose(kind: str, pose: int) -> dict[str, np.ndarray]:
    """Joint angles of a pose.

    Args:
        kind: the creature's kind.
        pose: 0 is the rest pose (no angles), any other number a seed; it does not depend on the body's seed.

    Returns:
        For the name of each moving chain ``(J, 3)`` rotation vectors in radians.
    """
    return {} if pose == 0 else _KINDS[kind](_Dice(np.random.default_rng(pose)))
