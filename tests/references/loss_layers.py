"""Slow twins of the soft maps and of the losses, with loops as the formulas say; and small exact groups."""

from math import exp, log

import torch
from torch import Tensor


def dihedral(n: int, seed: int = 0) -> Tensor:
    """D_n on ``3 n + 1`` vertices, as a table ``(2 n, 3 n + 1)``: a free orbit, a polygon's corners, one fixed point.

    Row ``2 r + s`` turns by r corners after s mirrorings; the vertices are numbered at random.
    """
    rows = []
    for r in range(n):
        for s in range(2):
            # The free orbit is the group itself, acted on from the left: (r, s) (q, t) = (r + q or r - q, s + t).
            free = [2 * ((r + (-q if s else q)) % n) + (s + t) % 2 for q in range(n) for t in range(2)]
            corners = [2 * n + (r + (-q if s else q)) % n for q in range(n)]
            rows.append([*free, *corners, 3 * n])
    return renumbered(torch.tensor(rows), seed)


def cyclic(n: int, seed: int = 0) -> Tensor:
    """C_n on ``2 n + 2`` vertices: two free orbits, an orbit of two (of one, where n is odd), as ``(n, 2 n + 2)``."""
    m = 2 if n % 2 == 0 else 1
    rows = []
    for r in range(n):
        free = [(r + q) % n + n * copy for copy in range(2) for q in range(n)]
        rows.append([*free, 2 * n + r % m, 2 * n + (1 + r) % m if m == 2 else 2 * n + 1])
    return renumbered(torch.tensor(rows), seed)


def renumbered(table: Tensor, seed: int) -> Tensor:
    new = torch.randperm(table.shape[1], generator=torch.Generator().manual_seed(seed))
    return new[table[:, torch.argsort(new)]]


def products(table: Tensor) -> Tensor:
    """Index of ``g o h``."""
    index = {tuple(row): i for i, row in enumerate(table.tolist())}
    return torch.tensor([[index[tuple(g[h].tolist())] for h in table] for g in table])


def similarity(f: Tensor, g: Tensor, kind: str) -> float:
    return float(f @ g) if kind == "dot" else -float(((f - g) ** 2).sum())


def soft_map(feat_x: Tensor, feat_y: Tensor, tau: float, k: int | None = None, kind: str = "dot") -> Tensor:
    """Row by row, dense, of one pair of shapes."""
    out = torch.zeros(len(feat_x), len(feat_y), dtype=feat_x.dtype)
    for x, f in enumerate(feat_x):
        values = [similarity(f, g, kind) for g in feat_y]
        best = sorted(range(len(values)), key=lambda y: -values[y])[:k]
        total = sum(exp((values[y] - values[best[0]]) / tau) for y in best)
        for y in best:
            out[x, y] = exp((values[y] - values[best[0]]) / tau) / total
    return out


def areas(truth: list[int], mass: list[float]) -> list[float]:
    known = [a if y >= 0 else 0.0 for y, a in zip(truth, mass, strict=True)]
    return [a / sum(known) for a in known]


def spectral(fmap: Tensor, even_x: Tensor, even_y: Tensor, truth: list[int], mass: list[float]) -> float:
    total = 0.0
    for x, (y, a) in enumerate(zip(truth, areas(truth, mass), strict=True)):
        if y >= 0:
            total += a * float((fmap @ even_x[x] - even_y[y]).norm() ** 2)
    return total


def assignment(pi: Tensor, truth: list[int], mass: list[float], table: Tensor, eps: float = 1e-12) -> float:
    total = 0.0
    for x, (y, a) in enumerate(zip(truth, areas(truth, mass), strict=True)):
        if y >= 0:
            orbit = {int(g[y]) for g in table}
            total -= a * log((sum(float(pi[x, z]) for z in orbit) + eps) / (1 + eps))
    return total


def distance(pi: Tensor, truth: list[int], mass: list[float], table: Tensor, dist: Tensor) -> float:
    total = 0.0
    for x, (y, a) in enumerate(zip(truth, areas(truth, mass), strict=True)):
        if y >= 0:
            orbit = {int(g[y]) for g in table}
            total += a * sum(float(pi[x, z]) * min(float(dist[o, z]) for o in orbit) ** 2 for z in range(pi.shape[1]))
    return total


def whole_map(
    pi: Tensor, truth: list[int], mass: list[float], table: Tensor, dist: Tensor | None, t: float, eps: float = 1e-12
) -> float:
    one = table[:1]  # the losses of single points, of the group of one element
    found = []
    for g in table.tolist():
        moved = [g[y] if y >= 0 else -1 for y in truth]
        found.append(assignment(pi, moved, mass, one, eps) if dist is None else distance(pi, moved, mass, one, dist))
    return min(found) if t == 0 else -t * log(sum(exp(-value / t) for value in found) / len(found))


def surfmnet(c12: Tensor, c21: Tensor, evals_1: Tensor, evals_2: Tensor, weights: tuple[float, float, float]) -> dict:
    """SURFMNet's three losses of square maps, pair by pair, as ULRSSM's class defines them."""
    bij, orth, lap = [], [], []
    for a, b, mu, lam in zip(c12, c21, evals_1, evals_2, strict=True):
        eye = torch.eye(len(a), dtype=a.dtype)
        bij.append((a @ b - eye).norm() ** 2 + (b @ a - eye).norm() ** 2)
        orth.append((a.T @ a - eye).norm() ** 2 + (b.T @ b - eye).norm() ** 2)
        lap.append(
            (a @ torch.diag(mu) - torch.diag(lam) @ a).norm() ** 2
            + (b @ torch.diag(lam) - torch.diag(mu) @ b).norm() ** 2
        )
    means = [torch.stack(values).mean() * weight for values, weight in zip((bij, orth, lap), weights, strict=True)]
    return dict(zip(("l_bij", "l_orth", "l_lap"), means, strict=True))


def consistency(pi: Tensor, values: Tensor, table_x: Tensor, table_y: Tensor, mass: list[float]) -> float:
    total = 0.0
    for g_x, g_y in zip(table_x.tolist(), table_y.tolist(), strict=True):
        for x in range(pi.shape[0]):
            first = sum(pi[g_x[x], y] * values[y] for y in range(pi.shape[1]))
            second = sum(pi[x, y] * values[g_y[y]] for y in range(pi.shape[1]))
            total += mass[x] / sum(mass) * float((first - second).norm() ** 2) / len(table_x)
    return total
