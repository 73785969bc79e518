"""Vertex block descent (Chen, Liu, Yang and Yuksel 2024): one Newton step per vertex, one vertex after another.

    B_i d_i = -grad_i g(p),   p_i += d_i,   B_i = q_i I + sum over its springs of k (nn' + max(0, 1 - r/l) (I - nn'))

with n the direction and l the length of a spring, and q the anchor stiffness (inertia and penalty pins). Compressed
springs lose their negative lateral curvature, so B_i is positive definite. A quadratic form adds its diagonal entry.
Contact adds its exact second derivatives, since it acts on single vertices. A projective energy of elements (strain
limits, dashpots) adds those of the vertex's elements. The paper has no line search. Here a step that would raise the
energy is replaced by that of the majorant (q_i + sum of k) I, which cannot raise it; hence no sweep raises the
objective. Energies without such a majorant, that is, energies that are not projective, are not supported.
`device: cuda` computes the same iterates in `solvers.cuda.device_vbd`. Vertices are processed by colour: no spring,
form or element joins two of the same colour.

    p_{k+1} = w_{k+1} (sweep(p_k) - p_{k-1}) + p_{k-1},    w_1 = 1,  w_2 = 2/(2 - rho^2),  w_{k+1} = 4/(4 - rho^2 w_k),

with a safeguard: an extrapolation that would raise the objective above that of p_k is rejected, and the weights restart
at w_1. With these restarts rho needs no tuning: overestimates perform as well as the exact value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.contact.touching import ContactEnergy, touching, without_contact
from solvers.core import vertex_terms
from solvers.core.bounds import is_bounded, without_bounded
from solvers.core.driver import Iterating, Iterative, largest
from solvers.core.parts import Parts, split
from solvers.core.vertex_blocks import VertexBlocks
from solvers.core.vertex_elements import Beside
from solvers.device import Precise
from solvers.kernels import vbd as kernels
from solvers.kernels.accelerate_springs import Shares
from solvers.kernels.half_spaces import HalfSpaces
from solvers.kernels.loop import EACH, ITERATIONS, LAST, Limits
from solvers.memory import aligned
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.problem import Positions, Prepared, StepProblem, System, Unsupported
from solvers.vectors.springs import LANES
from solvers.vectors.vbd import NUMBERS

if TYPE_CHECKING:
    from solvers.contact.energy import Planes
    from solvers.contact.local_global import Idle
    from solvers.core.fixed_objective import Objective

_FAR = 1e100
"""Coordinate at which padding springs of a packet end: far from all vertices, whatever the unit of length."""


@dataclass(frozen=True)
class VertexBlockDescent(Precise):
    """Vertex block descent for springs, quadratic forms, elements of projective energies, and contact.

    Args:
        spectral_radius: rho of the Chebyshev acceleration, in [0, 1); 0 disables it.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "vertex block descent",
        Reference(
            "Chen, Anka He and Liu, Ziheng and Yang, Yin and Yuksel, Cem",
            2024,
            "Vertex block descent",
            "10.1145/3658179",
        ),
    )

    spectral_radius: float = 0.999

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        super().__post_init__()
        if not 0.0 <= self.spectral_radius < 1.0:
            raise ValueError(f"spectral_radius: should be at least 0 and less than 1, not {self.spectral_radius}")

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            Unsupported: for other energies.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if self.device == "cuda":
            from solvers.cuda.device import ready  # for those who ask for it

            ready("vbd")
        bare, n = without_bounded(without_contact(system)), system.vertices
        parts, beside = split(bare), Beside.of(system)
        unknown = {*parts.unknown} - {type(energy).__name__ for energy in beside.energies}
        if unknown:
            raise Unsupported(
                f"vbd: {', '.join(sorted(unknown))} states no elements of a projective energy, and so neither whose "
                "neighbours its vertices are nor a bound of the second derivatives; a vertex's step needs both, the "
                "neighbours for the colouring and the bound for the fallback step that cannot raise the energy"
            )
        made = VertexBlocks.of(system, parts, beside)
        if self.device == "cuda":
            from solvers.cuda.vbd import prepare  # for those who ask for it

            return prepare(system, parts, made, self.spectral_radius, self.real)
        gauge = cast("Idle", CompiledLocalGlobal().prepare(system))
        shares = Shares.of(made.bundles, made.held, made.row[system.pins.vertices[system.pins.exact]])
        return PreparedVertexBlockDescent(
            system,
            parts,
            beside.among(made.row, n + 2),
            self.spectral_radius,
            kernels.Blocks(made.bundles, shares, made.free, made.bundles.in_lanes(made.majorant)),
            made.row,
            made.held,
            made.majorant[made.row],
            gauge,
            f"vertices in {made.colours} colours; for the residual alone {gauge.choice}",
        )


@dataclass(frozen=True, eq=False)
class PreparedVertexBlockDescent(Iterative):
    """Vertex block descent, prepared for a system.

    Attributes:
        parts: the springs and quadratic forms.
        beside: the elements of the other energies.
        blocks: packets of the free vertices by colour.
        row: (n,), row of each vertex in the packets.
        held: inertia and penalty pins of each row [N/m].
        majorant: (n,) [N/m], of all energies except contact.
        measure: computes the residual at p by one local-global iteration; it has no other use.
    """

    system: System
    parts: Parts
    beside: Beside
    spectral_radius: float
    blocks: kernels.Blocks
    row: NDArray[np.int64]
    held: NDArray[np.float64]
    majorant: NDArray[np.float64]
    measure: Idle
    choice: str

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.measure.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        sweeps = Sweeps(self, problem, guess)
        if not any(map(is_bounded, self.system.energies)):
            return sweeps
        from solvers.contact.pairs_vbd import Guarded  # for those who need it
        from solvers.core.objective import StepObjective

        step, gauge = StepObjective(self._objective, problem), self.measure.gauge(problem)
        return Guarded(sweeps, step, guess, self.majorant, self.spectral_radius, gauge)

    @cached_property
    def _objective(self) -> Objective:
        from solvers.core.fixed_objective import Objective

        return Objective(self.system)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual at p, by a local-global iteration if no contact is active."""
        return self.measure.gauge(problem)(p)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return largest(problem) * float(self.majorant[self.system.unpinned].sum()) ** 0.5

    def in_rows(self, x: Positions) -> NDArray[np.float64]:
        """Pack x (n, 3) into rows of four numbers.

        Two padding rows for the packets follow.
        """
        out = aligned(4 * (len(x) + 2))
        out.reshape(-1, 4)[self.row, :3] = x
        return out

    def spaces(self, contacts: list[ContactEnergy]) -> HalfSpaces:
        """Build the half-spaces of the contacts."""
        from solvers.contact.bundles import half_spaces  # for those who need it

        return half_spaces(contacts, self.row, self.blocks.bundles, self.blocks.unknowns)


class Sweeps(Iterating):
    """State of a solve: sweeps over all vertices in one step problem."""

    def __init__(self, prepared: PreparedVertexBlockDescent, problem: StepProblem, guess: Positions) -> None:
        contacts, blocks = touching(problem), prepared.blocks
        self._beside = prepared.beside.begun(problem)
        self._prepared, self._blocks, self._gauge = prepared, blocks, prepared.measure.gauge(problem)
        pull = vertex_terms.pull(replace(problem, force=prepared.parts.force(problem)))
        p, y = (prepared.in_rows(x) for x in (vertex_terms.placed(guess, problem), pull))
        self._right = blocks.bundles.right(prepared.held, y)
        self._spaces = prepared.spaces(contacts) if contacts else None
        p[-4] = _FAR
        entries = int(np.diff(blocks.bundles.start).max(initial=0))
        scratch = aligned(NUMBERS * LANES * entries), aligned(9 * LANES)
        self._work = kernels.SweepScratch(
            p.copy(), p.copy(), np.zeros_like(p), *scratch, np.zeros(1), np.full(1, np.nan)
        )
        self._rows, self.positions = p, guess

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        self.sweep(1)
        return True

    def residual(self) -> float:
        """Return the residual [J^(1/2)] of the iterate that `residual_of` names."""
        return self._gauge(self.positions)

    def alone(self, p: Positions) -> Positions:
        """Return the positions (n, 3) after a sweep from p without contact planes."""
        if p is not self.positions:
            self._begin_at(p)
        self.sweep(1)
        return self.positions

    def pushed(self, p: Positions, planes: Planes) -> Positions:
        """Return the positions (n, 3) after a sweep from p with the given contact planes."""
        from solvers.contact.bundles import of_planes

        made = self._prepared
        self._begin_at(p)
        touched = self._spaces
        self._spaces = of_planes(
            planes, np.ones(len(planes.vertices)), made.row, made.blocks.bundles, made.blocks.unknowns, both=True
        )
        self.sweep(1)
        self._spaces = touched
        return self.positions

    def _begin_at(self, p: Positions) -> None:
        """Restart the sweeps at p."""
        self._rows.reshape(-1, 4)[self._prepared.row, :3] = p
        self._work.omega[0], self._work.level[0] = 0.0, np.nan

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Run iterations within the limits, in one call if no residual can end them."""
        if limits.wanted == EACH:
            return super().iterate(limits)
        self.sweep(limits.iterations)
        return limits.iterations, self.residual() if limits.wanted == LAST else float("nan"), ITERATIONS

    def sweep(self, iterations: int) -> None:
        """Run sweeps over all vertices."""
        made = self._prepared
        made.beside.kernel(
            self._blocks,
            self._spaces,
            self._beside,
            self._right,
            made.spectral_radius,
            self._work,
            self._rows,
            iterations,
        )
        self.positions = self._rows.reshape(-1, 4)[made.row, :3].copy()
