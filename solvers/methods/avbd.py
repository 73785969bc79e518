"""Augmented vertex block descent (Giles, Diaz and Yuksel 2025): length constraints within the sweeps of VBD.

A constrained edge of length l has a tension t [N] and a stiffness k [N/m]:

    E_e = k/2 (l + t/k - clip(l + t/k, low, high))^2      in a sweep of `vertex_block.vbd` over all vertices
    t <- k (l + t/k - clip(l + t/k, low, high)),   k <- min(k + beta |l - clip(l, low, high)|, bound k_0)     after it

so t converges to the Lagrange multipliers of the step (`solvers.energies.augmented`), and the lengths
to their feasible values, for any k. A solve converges when the gradient that the best multipliers leave is below the
tolerance (`solvers.core.multipliers`), because the tensions t may cancel the gradient while
lengths are still wrong. Here beta = ramp k_0/high and k_0 = 1/(1/q_i + 1/q_j), the anchor stiffness of the two ends;
the paper has a beta of 10 N/m^2 and starts at 1 N/m. The choice here does not depend on the units of mass, length and
time. A larger ramp corrects lengths sooner, but leaves a larger gradient in the meantime.

A step starts with gamma t and max(gamma k, k_0) of the previous step, which the solution stores for this warm start,
gamma = `decay`. `stabilisation` alpha widens the limits by alpha times the error at the start of the
step, l - alpha (l^t - clip l^t): errors that few iterations left are corrected over several steps, not in one. With 0,
the default, a solve converges to the minimum of the step; the paper uses .95, and multiplies t by it too. With
`softened`, springs are edges too; their stiffness starts low and grows by the same rule up to its own
value (section 3.4), for large ratios of stiffness.

Further differences from the paper: instead of a diagonal in which the length of each column represents the second
derivatives across an edge, those of a tensile force are exact and those of a compressive force are dropped. A vertex
whose step would raise the augmented energy uses the step of its majorant. Sweeps are not accelerated, because each has
another energy; several accelerated sweeps before a dual step left larger length errors for the same work. Without
constrained edges and without `softened`, the method equals VBD.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core.bounds import is_bounded
from solvers.core.driver import Iterating, Iterative
from solvers.core.multipliers import Multipliers
from solvers.energies.augmented import Augmented, augmented, joined, off, penalties
from solvers.energies.springs import Springs
from solvers.held import Lengths
from solvers.kernels import avbd as kernels
from solvers.kernels import loop
from solvers.kernels.loop import Limits
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.methods.vbd import PreparedVertexBlockDescent, Sweeps, VertexBlockDescent
from solvers.problem import Positions, Prepared, StepProblem, System, Unsupported

if TYPE_CHECKING:
    from solvers.contact.local_global import Idle


@dataclass(frozen=True)
class AugmentedVertexBlockDescent:
    """Augmented vertex block descent for the energies of vertex block descent and length constraints.

    Args:
        ramp: growth of an edge's stiffness for a relative length error of 1, as a multiple of its initial
            stiffness; not negative.
        bound: largest stiffness as a multiple of the initial one, at least 1.
        decay: fraction of tensions and stiffnesses that the next step starts with, 0 to 1.
        stabilisation: fraction of the initial length error that a step retains, 0 to 1.
        softened: whether the stiffness of springs starts low and grows.
        spectral_radius: as in `VertexBlockDescent`, used if nothing is constrained or ramped.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = False
    keeps_lengths: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "vertex block descent",
        Reference(
            "Giles, Chris and Diaz, Elie and Yuksel, Cem",
            2025,
            "Augmented vertex block descent",
            "10.1145/3731195",
        ),
    )

    ramp: float = 1e3
    bound: float = 1e6
    decay: float = 0.99
    stabilisation: float = 0.0
    softened: bool = False
    spectral_radius: float = 0.999

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        for name, least, most in (("ramp", 0, np.inf), ("bound", 1, np.inf), ("decay", 0, 1), ("stabilisation", 0, 1)):
            if not least <= (came := getattr(self, name)) <= most:
                wanted = f"from {least} to {most}" if most == 1 else f"at least {least}"
                raise ValueError(f"{name}: should be {wanted}, not {came}")
        VertexBlockDescent(self.spectral_radius)

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            Unsupported: for what `VertexBlockDescent` does not support, and for surface contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        usual = VertexBlockDescent(self.spectral_radius)
        if not (system.lengths or self.softened):
            return usual.prepare(system)
        if any(map(is_bounded, system.energies)):
            raise Unsupported(
                "avbd: does not support surface contact together with length constraints; remove self-contact and "
                "surface-contact, or give springs and strain limits a numerical stiffness"
            )
        edges, energies, k = joined(system.lengths), system.energies, np.empty(0)
        if self.softened:
            springs = Springs.joined([energy for energy in energies if isinstance(energy, Springs)])
            energies = tuple(energy for energy in energies if not isinstance(energy, Springs))
            r, k = springs.rest_length, springs.stiffness
            edges = joined([edges, Lengths(springs.edges, r, r, springs.rest_direction)])
        exact = np.arange(len(edges.low)) < len(edges.low) - len(k)
        bare = replace(system, energies=energies)
        least = penalties(bare, edges)
        most = np.concatenate([self.bound * least[exact], k])
        least = np.minimum(least, most)
        made = usual.prepare(augmented(bare, edges, least, np.zeros(len(least))))
        return PreparedAugmented(system, cast(PreparedVertexBlockDescent, made), self, edges, least, most, exact)


@dataclass(frozen=True, eq=False)
class PreparedAugmented(Iterative):
    """AVBD, prepared for a system.

    Attributes:
        made: vertex block descent of the other energies, with the initial stiffness of the edges in its majorant.
        edges: constrained edges, and springs with ramped stiffness.
        least, most: (m,) [N/m], bounds of the edges' stiffness.
        exact: (m,), whether an edge is constrained.
    """

    keeps_lengths: ClassVar[bool] = True

    system: System
    made: PreparedVertexBlockDescent
    method: AugmentedVertexBlockDescent
    edges: Lengths
    least: NDArray[np.float64]
    most: NDArray[np.float64]
    exact: NDArray[np.bool_]

    @cached_property
    def multipliers(self) -> Multipliers:
        """Return the least-squares multipliers of the length constraints."""
        return Multipliers(self._with(np.zeros(len(self.least))), self._exact_lengths, self.least[self.exact])

    @property
    def choice(self) -> str:
        """Description of the prepared solver."""
        return self.made.choice

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.made.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return Augmenting(self, problem, guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at positions p (n, 3) with zero tensions."""
        return self.residual(problem, p, np.zeros(len(self.least)))

    def residual(self, problem: StepProblem, p: Positions, tension: NDArray[np.float64]) -> float:
        """Return |Q^-1 grad L|_Q [J^(1/2)] of the augmented Lagrangian.

        Args:
            problem: the step problem.
            p: positions (n, 3) [m].
            tension: (m,) [N].

        Returns:
            The residual of L with the initial stiffnesses, which are part of Q.
        """
        return self._gauge.gauge(replace(problem, system=self._with(tension)))(p)

    def _with(self, tension: NDArray[np.float64]) -> System:
        """Return the system of L: the constrained lengths and the other energies."""
        exact = self.exact
        return augmented(self.system, self._exact_lengths, self.least[exact], tension[exact])

    @cached_property
    def _exact_lengths(self) -> Lengths:
        e, exact = self.edges, self.exact
        return Lengths(e.edges[exact], e.low[exact], e.high[exact], e.rest_direction[exact])

    @cached_property
    def _gauge(self) -> Idle:
        """Return the residual solver: that of `VertexBlockDescent`, or with full spring stiffness if ramped."""
        if self.exact.all():
            return self.made.measure
        return cast("Idle", CompiledLocalGlobal().prepare(self._with(np.zeros(len(self.least)))))


class Augmenting(Sweeps):
    """State of an AVBD solve: sweeps and dual updates of one step problem."""

    def __init__(self, prepared: PreparedAugmented, problem: StepProblem, guess: Positions) -> None:
        made, method, edges = prepared.made, prepared.method, prepared.edges
        super().__init__(made, replace(problem, system=made.system), guess)
        self._augmented, self._problem = prepared, problem
        kept = problem.start.kept
        begun = np.zeros((len(prepared.least), 2)) if kept is None else method.decay * kept
        past = method.stabilisation * np.where(prepared.exact, off(edges, problem.start.positions), 0.0)
        base = np.ones(made.system.vertices + 2)
        first = cast(Augmented, made.system.energies[-1])
        base[made.row] = made.majorant - first.stiffness_matrix(made.system.vertices).diagonal()
        self._duals = kernels.Duals(
            edges.low + past,
            edges.high + past,
            prepared.exact,
            method.ramp * prepared.least / np.where(edges.high > 0.0, edges.high, 1.0),
            prepared.most,
            prepared.most * edges.high,
            np.clip(begun[:, 1], prepared.least, prepared.most),
            np.where(prepared.exact, begun[:, 0], 0.0),
            base,
            np.empty_like(base),
        )
        *others, hard = cast(tuple[Any, ...], self._beside)
        self._hard = hard._replace(numbers=hard.numbers.copy())
        self._beside = (*others, self._hard)
        self._blocks = self._blocks._replace(majorant=self._blocks.majorant.copy())
        self._kernel = kernels.augmenting(made.beside.kernel)
        kernels.place(self._blocks, self._hard, self._duals, self._rows)

    @property
    def kept(self) -> NDArray[np.float64]:
        """Tensions [N] and stiffnesses [N/m], (m, 2), for the warm start of the next step."""
        return np.column_stack([self._duals.tension, self._duals.stiffness])

    def residual(self) -> float:
        """Return the residual with the current tensions; it may be small while lengths are wrong."""
        return self._augmented.residual(self._problem, self.positions, self._duals.tension)

    def residual_of_step(self) -> float:
        """Return the residual [J^(1/2)] with least-squares multipliers, which includes length errors."""
        if not np.isfinite(self.positions).all():
            return self.residual()
        tension = np.zeros(len(self._duals.exact))
        tension[self._duals.exact] = self._augmented.multipliers.at(self._problem, self.positions)
        return self._augmented.residual(self._problem, self.positions, tension)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Run iterations within the limits; the returned residual is `residual_of_step`.

        `residual_of_step` requires a factorisation. It is evaluated once the residual with the method's own
        tensions is small enough, and again each time the number of iterations has grown by half since.
        """
        count, residual, ended = super().iterate(limits)
        if limits.wanted == loop.NEVER or not self._duals.exact.any():
            return count, residual, ended
        residual, since = self.residual_of_step(), 0
        while ended == loop.TOLERANCE and not residual <= limits.limit:
            some = min(1 + since // 2, limits.iterations - count)
            if some == 0:
                return count, residual, loop.ITERATIONS
            self.sweep(some)
            count, since, residual = count + some, since + some, self.residual_of_step()
        return count, residual, ended

    def sweep(self, iterations: int) -> None:
        """Run sweeps, each followed by a dual update."""
        self._kernel(
            self._blocks, self._spaces, self._beside, self._right,
            self._work, self._rows, iterations, self._hard, self._duals,
        )  # fmt: skip
        self.positions = self._rows.reshape(-1, 4)[self._prepared.row, :3].copy()
