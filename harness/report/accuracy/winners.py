"""Cheapest family of methods for an error, by the stiffness number of a mesh.

    stiffness number = k dt^2/m,    dt = 1/30 s, a frame;    k of the median spring, m of the mean free vertex

The cost of a method for an error is the minimum over its simulations within that error, whatever their time steps and
tolerances. Families are those of the solvers; methods that minimise an integrator's step are grouped by its order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, isfinite

from harness.report.accuracy.measured import WorkPoint
from harness.report.style import Mark, numbered
from solvers.integrators import INTEGRATORS

FRAME = 1.0 / 30.0
"""Seconds."""
ERRORS = tuple(10.0**-k for k in range(1, 9))
"""Relative errors of the positions at the end time."""
NOBODY = "none that was tried"
CLOSE = 1.25
"""Cost ratio below which two families count as equal."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One error on one mesh, with the cheapest simulation of each family that reaches it.

    Costs are processor seconds per simulated second.
    """

    scene: str
    vertices: int
    number: float
    error: float
    prices: dict[str, WorkPoint]

    @property
    def winner(self) -> str:
        """The family of the cheapest simulation."""
        return min(self.prices, key=lambda name: self.prices[name].cpu, default=NOBODY)

    @property
    def ahead(self) -> float:
        """The cost of the second cheapest family divided by the cheapest.

        It is infinite without a second family.
        """
        order = sorted(work.cpu for work in self.prices.values())
        return order[1] / order[0] if len(order) > 1 else inf


def family(work: WorkPoint) -> str:
    """Return the family of a simulation's method."""
    if not work.minimises:
        return work.family
    shipped = INTEGRATORS.get(work.integrator)
    return f"implicit, order {shipped.order}" if shipped else work.integrator


def cells(works: Iterable[WorkPoint], errors: Sequence[float] = ERRORS) -> list[Cell]:
    """Build a cell for each mesh and error.

    Cells are ordered by vertices, stiffness and error; meshes without springs have none.
    """
    meshes: dict[tuple[str, int, float], list[WorkPoint]] = {}
    for work in works:
        if isfinite(work.stiffness) and work.vertices:
            meshes.setdefault((work.scene, work.vertices, work.stiffness), []).append(work)
    found = list[Cell]()
    for (scene, vertices, stiffness), members in meshes.items():
        done = [work for work in members if work.status == "ok" and isfinite(work.cpu) and work.cpu > 0.0]
        for error in errors:
            best: dict[str, WorkPoint] = {}
            for work in done:
                if work.error <= error:
                    name = family(work)
                    best[name] = min(best.get(name, work), work, key=lambda one: one.cpu)
            found.append(Cell(scene, vertices, stiffness * FRAME**2, error, best))
    return sorted(found, key=lambda cell: (cell.vertices, cell.number, -cell.error))


def families(found: Sequence[Cell]) -> dict[str, Mark]:
    """Assign a style to each family; equal sets of names get equal styles."""
    names = sorted({name for cell in found for name in cell.prices})
    return {name: numbered(k) for k, name in enumerate(names)}
