"""Augmented vertex block descent (Giles, Diaz and Yuksel 2025): exact lengths within the sweeps of `vbd`.

An edge of length l that is exact has a tension t [N] and a stiffness k [N/m]:

    E_e = k/2 (l + t/k - clip(l + t/k, low, high))^2        in a sweep of `solvers.methods.vbd`, all vertices once
    t <- k (l + t/k - clip(l + t/k, low, high)),   k <- min(k + beta |l - clip(l, low, high)|, bound k_0)     after it

so t tends to the Lagrange multipliers of the step (`solvers.energies.augmented`), and lengths to what they may be,
whatever k is. A solve ends by its tolerance where the gradient that the best multipliers leave is small enough
(`solvers.core.multipliers`): the tensions t may cancel it while lengths are still wrong. Here beta = ramp k_0/high and
k_0 = 1/(1/q_i + 1/q_j), what the ends hold themselves with, where the paper has a beta of 10 N/m^2 and begins with 1
N/m: so units of mass, length and time do not matter. A larger ramp mends lengths sooner, and leaves more of the
gradient meanwhile.

A step begins with gamma t and max(gamma k, k_0) of the step before, which the solution keeps for it, gamma = `decay`.
With `stabilisation` alpha limits are alpha times wider by what was off when the step began, l - alpha (l^t - clip l^t):
errors that few iterations left are mended over some steps and not at once. With 0, the default, a solve tends to the
minimum of the step; the paper takes .95, and multiplies t by it too. With `softened`, springs are edges as well that
begin soft and whose stiffness grows by the same rule up to their own (section 3.4): for ratios of stiffness.

What differs beside: in place of a diagonal in which each column's length stands for the second derivatives across an
edge, that of a pull is exact and that of a push left out, and a vertex whose step would raise the augmented energy
takes that of its majorant. Sweeps are not accelerated, for each has another energy; several of them before a dual
step, accelerated, were tried and left lengths farther off for the same work. Nothing exact and nothing softened: this
is `vbd`.
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
    """Augmented vertex block descent over what vertex block descent takes, and exact lengths.

    ramp: how many times its first stiffness an edge gains when it is off by its length, not negative; bound: the
    largest stiffness, as a multiple of the first, at least 1; decay: what of tensions and stiffnesses the next step
    begins with, from 0 to 1; stabilisation: what of the error that a step begins with it keeps, from 0 to 1; softened:
    whether springs begin soft; spectral_radius: of `vbd`, where nothing is exact or softened.
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
        """Raises ValueError."""
        for name, least, most in (("ramp", 0, np.inf), ("bound", 1, np.inf), ("decay", 0, 1), ("stabilisation", 0, 1)):
            if not least <= (came := getattr(self, name)) <= most:
                wanted = f"from {least} to {most}" if most == 1 else f"at least {least}"
                raise ValueError(f"{name}: should be {wanted}, not {came}")
        VertexBlockDescent(self.spectral_radius)

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported for what `vbd` refuses, and for surfaces that touch, NotPositiveDefinite."""
        usual = VertexBlockDescent(self.spectral_radius)
        if not (system.lengths or self.softened):
            return usual.prepare(system)
        if any(map(is_bounded, system.energies)):
            raise Unsupported(
                "avbd: a step may pass no surface that touches, and exact lengths move what a step is; take out "
                "self-contact and surface-contact, or give springs and strain limits a stiffness in figures"
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
    """made: vertex block descent with the edges beside all else, their first stiffness in its majorant; edges: those
    that are exact and those that begin soft; least, most: their stiffnesses (m,) [N/m]; exact (m,): which are."""

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
        """Those of the exact lengths, by least squares."""
        return Multipliers(self._with(np.zeros(len(self.least))), self._exact_lengths, self.least[self.exact])

    @property
    def choice(self) -> str:
        """See Prepared."""
        return self.made.choice

    @property
    def facts(self) -> dict[str, float]:
        """See Prepared."""
        return self.made.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative."""
        return Augmenting(self, problem, guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative; with no tensions."""
        return self.residual(problem, p, np.zeros(len(self.least)))

    def residual(self, problem: StepProblem, p: Positions, tension: NDArray[np.float64]) -> float:
        """|Q^-1 grad L|_Q [J^(1/2)] at p with tensions (m,) [N], L with the first stiffnesses, which are in Q."""
        return self._gauge.gauge(replace(problem, system=self._with(tension)))(p)

    def _with(self, tension: NDArray[np.float64]) -> System:
        """The system of L, of exact lengths and the energies that there are."""
        exact = self.exact
        return augmented(self.system, self._exact_lengths, self.least[exact], tension[exact])

    @cached_property
    def _exact_lengths(self) -> Lengths:
        e, exact = self.edges, self.exact
        return Lengths(e.edges[exact], e.low[exact], e.high[exact], e.rest_direction[exact])

    @cached_property
    def _gauge(self) -> Idle:
        """What tells residuals: what `vbd` has for that, or of springs as they are where they begin soft."""
        if self.exact.all():
            return self.made.measure
        return cast("Idle", CompiledLocalGlobal().prepare(self._with(np.zeros(len(self.least)))))


class Augmenting(Sweeps):
    """Sweeps and dual steps of one step problem."""

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
        """Tensions [N] and stiffnesses [N/m], (m, 2)."""
        return np.column_stack([self._duals.tension, self._duals.stiffness])

    def residual(self) -> float:
        """With the tensions that it has: it may be small where lengths are wrong."""
        return self._augmented.residual(self._problem, self.positions, self._duals.tension)

    def residual_of_step(self) -> float:
        """The residual [J^(1/2)] with the multipliers of least squares, in which wrong lengths count."""
        if not np.isfinite(self.positions).all():
            return self.residual()
        tension = np.zeros(len(self._duals.exact))
        tension[self._duals.exact] = self._augmented.multipliers.at(self._problem, self.positions)
        return self._augmented.residual(self._problem, self.positions, tension)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating; the residual is that of the step.

        It takes a factorisation, so it is looked at where that with the method's own tensions is small enough, and then
        again whenever half as many iterations have been done since as at the last look.
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
        """That many, each with a dual step after it."""
        self._kernel(
            self._blocks, self._spaces, self._beside, self._right,
            self._work, self._rows, iterations, self._hard, self._duals,
        )  # fmt: skip
        self.positions = self._rows.reshape(-1, 4)[self._prepared.row, :3].copy()
