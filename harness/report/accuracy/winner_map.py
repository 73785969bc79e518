"""Cheapest family of methods for an error, by the stiffness number of a mesh.

    stiffness number = k dt^2/m,    dt = 1/30 s, a frame;    k of the median spring, m of the mean free vertex

The cost of a method for an error is the minimum over its simulations within that error, whatever their time steps and
tolerances. Families are those of the solvers; methods that minimise an integrator's step are grouped by its order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, isfinite

from springbench.harness.report.accuracy.accuracy_data import WorkPoint
from springbench.harness.report.plot_style import SeriesStyle, build_indexed_style
from springbench.solvers.model.integrators import INTEGRATORS

FRAME_SECONDS = 1.0 / 30.0
"""Length of a frame [s]."""
ERROR_TARGETS = tuple(10.0**-k for k in range(1, 9))
"""Relative errors of the positions at the end time."""
NO_WINNER = "none that was tried"


@dataclass(frozen=True, slots=True)
class WinnerCell:
    """One error on one mesh, with the cheapest simulation of each family that reaches it.

    Costs are processor seconds per simulated second.
    """

    scene: str
    vertices: int
    stiffness_number: float
    error: float
    cheapest_by_family: dict[str, WorkPoint]

    @property
    def cheapest_family(self) -> str:
        """The family of the cheapest simulation."""
        return min(
            self.cheapest_by_family,
            key=lambda name: self.cheapest_by_family[name].cpu_seconds_per_simulated_second,
            default=NO_WINNER,
        )

    @property
    def lead_ratio(self) -> float:
        """The cost of the second cheapest family divided by the cheapest.

        It is infinite without a second family.
        """
        order = sorted(work.cpu_seconds_per_simulated_second for work in self.cheapest_by_family.values())
        return order[1] / order[0] if len(order) > 1 else inf


def method_family(work: WorkPoint) -> str:
    """Return the family of a simulation's method."""
    if not work.is_minimiser:
        return work.family
    shipped = INTEGRATORS.get(work.integrator)
    return f"implicit, order {shipped.order}" if shipped else work.integrator


def build_winner_cells(works: Iterable[WorkPoint], errors: Sequence[float] = ERROR_TARGETS) -> list[WinnerCell]:
    """Build a cell for each mesh and error.

    Args:
        works: simulations; those of meshes without springs are ignored.
        errors: largest relative errors, one for each cell of a mesh.

    Returns:
        The cells, ordered by vertices, stiffness and decreasing error; a cell is empty where nothing is so accurate.
    """
    meshes: dict[tuple[str, int, float], list[WorkPoint]] = {}
    for work in works:
        if isfinite(work.stiffness) and work.vertices:
            meshes.setdefault((work.scene, work.vertices, work.stiffness), []).append(work)
    found = list[WinnerCell]()
    for (scene, vertices, stiffness), members in meshes.items():
        done = [
            work
            for work in members
            if work.status == "ok"
            and isfinite(work.cpu_seconds_per_simulated_second)
            and work.cpu_seconds_per_simulated_second > 0.0
        ]
        for error in errors:
            best: dict[str, WorkPoint] = {}
            for work in done:
                if work.error <= error:
                    name = method_family(work)
                    best[name] = min(best.get(name, work), work, key=lambda one: one.cpu_seconds_per_simulated_second)
            found.append(WinnerCell(scene, vertices, stiffness * FRAME_SECONDS**2, error, best))
    return sorted(found, key=lambda cell: (cell.vertices, cell.stiffness_number, -cell.error))


def assign_family_styles(cells: Sequence[WinnerCell]) -> dict[str, SeriesStyle]:
    """Assign a style to each family; equal sets of names get equal styles."""
    names = sorted({name for cell in cells for name in cell.cheapest_by_family})
    return {name: build_indexed_style(k) for k, name in enumerate(names)}
