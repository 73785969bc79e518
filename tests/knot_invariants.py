"""Which knot a rope is tied in, by a number that no motion changes unless the rope passes through itself."""

from __future__ import annotations

import numpy as np
from springbench.solvers.model.step_problem import Positions


def knot_determinant(p: Positions) -> int:
    """The determinant of the knot of an open rope p (n, 3) whose first and last vertex lie outermost along x: 1 where
    there is none, 3 for the overhand knot (Fox's colourings: Livingston 1993, Knot Theory, chapter 3).

    Seen along z. Each arc from one crossing below to the next is an unknown; each crossing says 2 over = in + out.
    """
    flat, found = p[:, :2], list[tuple[float, float]]()  # places along the rope: below, above
    for i in range(len(p) - 1):
        for j in range(i + 2, len(p) - 1):
            u, v, w = flat[i + 1] - flat[i], flat[j + 1] - flat[j], flat[j] - flat[i]
            area = u[0] * v[1] - u[1] * v[0]
            if area == 0.0:
                continue
            s, t = (w[0] * v[1] - w[1] * v[0]) / area, (w[0] * u[1] - w[1] * u[0]) / area
            if 0.0 <= s < 1.0 and 0.0 <= t < 1.0:
                one, two = p[i, 2] + s * (p[i + 1, 2] - p[i, 2]), p[j, 2] + t * (p[j + 1, 2] - p[j, 2])
                found.append((i + s, j + t) if one < two else (j + t, i + s))
    below = np.sort([place for place, _ in found])
    rows = np.zeros((len(found), len(found) + 1))
    for k, place in enumerate(below):
        over = next(above for under, above in found if under == place)
        rows[k, np.searchsorted(below, over)] += 2.0
        rows[k, [k, k + 1]] -= 1.0
    return round(abs(float(np.linalg.det(rows[:, 1:])))) if found else 1
