# pyright: reportUnknownLambdaType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# Lambdas have the types of the fields that they are passed to.
"""The assignment's program with one mistake built in, as step maps p^(t-dt), p^t -> p.

    Q = A' K_Q A + M_Q/dt_Q^2 + w_Q C'C
    b = A' K_b d + M_y target/dt_y^2 + F f_ext + w_b C'C p_rest

The correct program has K_Q = K_b = K, M_Q = M_y = M, dt_Q = dt_y = dt, w_Q = w_b = w, F = 1,
target = 2 p^t - p^(t-dt) and d_e = r_e v_e/|v_e|. A mistake replaces some of these. Exact pins are penalties whose
weight is EXACT_PIN_FACTOR times the largest diagonal entry of Q.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu
from springbench.harness.experiments.grading.spring_terms import SpringTerms
from springbench.harness.experiments.grading.submission import AXES
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.edge_energy import unit_directions
from springbench.solvers.model.step_problem import Positions

EXACT_PIN_FACTOR = 1e9
"""Weight of an exact pin relative to the largest diagonal entry of Q."""

RealArray = NDArray[np.float64]
ForceMap = Callable[[Positions], Positions]
SpringVectors = Callable[[RealArray, RealArray, RealArray, RealArray], RealArray]
"""Computes d (m, 3) from vectors v (m, 3), unit directions (m, 3), rest lengths (m,), and current lengths (m,)."""


def _project(v: RealArray, unit: RealArray, rest: RealArray, current: RealArray) -> RealArray:
    return rest[:, None] * unit


class StepBatch(NamedTuple):
    """Some steps of a submission, with the forces and pins of the scene's problems.

    Arrays are (s, n, 3) [m] unless stated.

    Attributes:
        previous: p^(t-dt).
        current: p^t.
        target: inertial target.
        force: external forces [N].
        pin_targets: (s, q, 3) [m].
        after: p, which programs are to predict.
    """

    previous: Positions
    current: Positions
    target: Positions
    force: Positions
    pin_targets: Positions
    after: Positions

    def select_steps(self, rows: Sequence[int]) -> StepBatch:
        """Return the batch of some of the steps."""
        return StepBatch(*(array[list(rows)] for array in self))


@dataclass(frozen=True, eq=False)
class AssignmentProgram:
    """The assignment's program, or one with a mistake.

    Attributes:
        edges: springs (m, 2).
        rest_length: (m,) [m].
        rest_direction: (m, 3).
        system_stiffness, side_stiffness: K_Q, K_b (m,) [N/m].
        system_mass, target_mass: M_Q, M_y (n,) [kg].
        system_step, target_step: dt_Q, dt_y [s].
        pinned: vertices of the pins (q,).
        system_weight, side_weight: w_Q, w_b (q,) [N/m].
        pin_places: places (n, 3) [m] of pins that are not the scene's; None for the scene's pins.
        map_force: F.
        map_target: inertial target (n, 3) [m], of target, p^t and p^(t-dt).
        uses_iterate: whether the target uses the iterate instead of p^t.
        compute_directions: d.
        explicit_at: positions at which an explicit step has its spring forces, "current" (p^t) or "previous"
            (p^(t-dt)); "" for an implicit step.
        initial_guess: "current" or "target".
    """

    edges: NDArray[np.int64]
    rest_length: RealArray
    rest_direction: RealArray
    system_stiffness: RealArray
    side_stiffness: RealArray
    system_mass: RealArray
    target_mass: RealArray
    system_step: float
    target_step: float
    pinned: NDArray[np.int64]
    system_weight: RealArray
    side_weight: RealArray
    pin_places: Positions | None = None
    map_force: ForceMap = field(default=lambda f: f)
    map_target: Callable[[Positions, Positions, Positions], Positions] = field(default=lambda q, p, before: q)
    uses_iterate: bool = False
    compute_directions: SpringVectors = field(default=_project)
    explicit_at: str = ""
    initial_guess: str = "current"

    @classmethod
    def from_terms(cls, terms: SpringTerms) -> AssignmentProgram:
        """Build the correct program."""
        heavy = EXACT_PIN_FACTOR * float(terms.build_system_matrix().diagonal().max(initial=0.0))
        weight = np.where(terms.soft_mask, terms.weight, heavy)
        return cls(
            terms.edges,
            terms.rest_length,
            terms.rest_direction,
            terms.stiffness,
            terms.stiffness,
            terms.mass,
            terms.mass,
            terms.time_step,
            terms.time_step,
            terms.pinned,
            weight,
            weight,
        )

    @cached_property
    def _incidence(self) -> csr_array:
        return system_matrix_assembly.signed_incidence_matrix_sparse(self.edges, len(self.system_mass))

    @cached_property
    def _incidence_transpose(self) -> csr_array:
        return csr_array(self._incidence.T)

    @cached_property
    def _factor(self) -> Any:
        """Factor of Q; raises RuntimeError where Q is singular."""
        K = system_matrix_assembly.diagonal_matrix(self.system_stiffness)
        diagonal = self.system_mass / self.system_step**2
        diagonal = diagonal + np.bincount(self.pinned, self.system_weight, minlength=len(diagonal))
        Q = self._incidence_transpose @ K @ self._incidence + system_matrix_assembly.diagonal_matrix(diagonal)
        return splu(Q.tocsc())

    def iterate_steps(self, steps: StepBatch) -> Iterator[Positions]:
        """Yield the iterates (s, n, 3) [m] of some steps, without end.

        Raises RuntimeError where Q is singular.
        """
        force = self.map_force(steps.force)
        target = self.map_target(steps.target, steps.current, steps.previous)
        if self.explicit_at:
            p = self._step_explicitly(steps, force)
            while True:
                yield p
        i, j = self.edges.T
        s, m = len(target), len(i)
        inertia = self.target_mass[:, None] / self.target_step**2
        places = steps.pin_targets if self.pin_places is None else self.pin_places[self.pinned]
        fixed = force + np.zeros_like(target)
        fixed[:, self.pinned] += self.side_weight[:, None] * places
        rest, direction = np.tile(self.rest_length, s), np.tile(self.rest_direction, (s, 1))
        current_length = np.linalg.norm(steps.current[:, i] - steps.current[:, j], axis=2).ravel()
        p = target if self.initial_guess == "target" else steps.current
        while True:
            v = (p[:, i] - p[:, j]).reshape(-1, 3)
            _, unit = unit_directions(v, direction)
            d = self.compute_directions(v, unit, rest, current_length).reshape(s, m, 3)
            goal = 2.0 * p - steps.previous if self.uses_iterate else target
            side = inertia * goal + fixed + self._scatter(self.side_stiffness[:, None] * d)
            p = _unstack(self._factor.solve(_stack(side)), s)
            yield p

    def _scatter(self, d: RealArray) -> RealArray:
        """Return A'd (s, n, 3) of d (s, m, 3)."""
        return _unstack(self._incidence_transpose @ _stack(d), len(d))

    def _step_explicitly(self, steps: StepBatch, force: Positions) -> Positions:
        """Return the explicit steps (s, n, 3) [m]."""
        i, j = self.edges.T
        at = steps.current if self.explicit_at == "current" else steps.previous
        v = at[:, i] - at[:, j]
        flat = v.reshape(-1, 3)
        _, unit = unit_directions(flat, np.tile(self.rest_direction, (len(at), 1)))
        pull = self._scatter(self.side_stiffness[:, None] * (v - self.rest_length[:, None] * unit.reshape(v.shape)))
        mass = np.where(self.target_mass > 0.0, self.target_mass, np.inf)[:, None]
        p = steps.target + self.target_step**2 * (force - pull) / mass
        p[:, self.pinned] = steps.pin_targets
        return p


def _stack(x: RealArray) -> RealArray:
    """Return (s, k, 3) as columns (k, 3 s)."""
    return np.ascontiguousarray(x.transpose(1, 0, 2)).reshape(x.shape[1], -1)


def _unstack(x: RealArray, s: int) -> RealArray:
    """Return columns (k, 3 s) as (s, k, 3)."""
    return x.reshape(len(x), s, 3).transpose(1, 0, 2)


@dataclass(frozen=True, slots=True, eq=False)
class ProgramMistake:
    """A mistake, as changes of the correct program or of its output.

    Attributes:
        name: short name, in tables.
        description: what the program does, as a sentence without its subject.
        remedy: what to look at.
        variants: programs with the mistake, each made of the correct one and the rest positions (n, 3) [m].
        is_late: whether the positions are one frame late.
        axes: orders of the axes in which the positions are written.
    """

    name: str
    description: str
    remedy: str
    variants: tuple[Callable[[AssignmentProgram, Positions], AssignmentProgram], ...] = ()
    is_late: bool = False
    axes: tuple[tuple[int, ...], ...] = ()


def _change(**changes: Any) -> Callable[[AssignmentProgram, Positions], AssignmentProgram]:
    """Return a variant that replaces fields by constants."""
    return lambda program, rest: replace(program, **changes)


def _scale(**factors: float) -> Callable[[AssignmentProgram, Positions], AssignmentProgram]:
    """Return a variant that multiplies fields."""
    return lambda program, rest: replace(program, **{key: f * getattr(program, key) for key, f in factors.items()})


def _fill(*names: str) -> Callable[[AssignmentProgram, Positions], AssignmentProgram]:
    """Return a variant that sets fields to 1."""
    return lambda program, rest: replace(program, **{key: np.ones_like(getattr(program, key)) for key in names})


def _permute_force(order: Sequence[int]) -> Callable[[AssignmentProgram, Positions], AssignmentProgram]:
    return _change(map_force=lambda f: f[..., list(order)])


def _shift_pins(shift: int) -> Callable[[AssignmentProgram, Positions], AssignmentProgram]:
    """Return a variant whose pins have numbers that differ by a constant."""

    def shift_pins(program: AssignmentProgram, rest: Positions) -> AssignmentProgram:
        pins = program.pinned + shift
        there = (pins >= 0) & (pins < len(rest))
        weights = {key: getattr(program, key)[there] for key in ("system_weight", "side_weight")}
        return replace(program, pinned=pins[there], pin_places=rest, **weights)

    return shift_pins


def change_time_step(program: AssignmentProgram, time_step: float) -> AssignmentProgram:
    """Return the program with another time step in both the system matrix and the target.

    Args:
        program: correct or mistaken program.
        time_step: time step [s].
    """
    return replace(program, system_step=time_step, target_step=time_step)


def _multiply_force(exponent: float) -> Callable[[AssignmentProgram, Positions], AssignmentProgram]:
    """Return a variant whose force is multiplied by a power of the mass."""

    def multiply_force(program: AssignmentProgram, rest: Positions) -> AssignmentProgram:
        mass = np.where(program.target_mass > 0.0, program.target_mass, np.inf)
        factor = np.where(np.isfinite(mass), mass**exponent, 0.0)[:, None]
        return replace(program, map_force=lambda f: factor * f)

    return multiply_force


MISTAKES: tuple[ProgramMistake, ...] = (
    ProgramMistake(
        "force times mass",
        "multiplies the external force by the masses, as if it were an acceleration",
        "f_ext is in newtons in y; it is not multiplied by M",
        (_multiply_force(1.0),),
    ),
    ProgramMistake(
        "force without mass",
        "divides the external force by the masses, as if gravity were a force of 9.8 N",
        "gravity is m g at each vertex",
        (_multiply_force(-1.0),),
    ),
    ProgramMistake(
        "no external force",
        "leaves out the external force",
        "y ends in + f_ext",
        (_change(map_force=np.zeros_like),),
    ),
    ProgramMistake(
        "force upwards",
        "applies the external force with the wrong sign",
        "y ends in + f_ext",
        (_change(map_force=np.negative),),
    ),
    ProgramMistake(
        "force on another axis",
        "applies the external force along another axis",
        "the vertical axis of the scene",
        tuple(_permute_force(order) for order in ((1, 0, 2), (0, 2, 1), (2, 1, 0))),
    ),
    ProgramMistake(
        "masses left out of y",
        "leaves the masses out of y",
        "y = M (2 p^t - p^(t-dt))/dt^2 + f_ext",
        (_fill("target_mass"),),
    ),
    ProgramMistake(
        "masses left out of Q",
        "leaves the masses out of Q",
        "Q = k A'A + M/dt^2 + w C'C",
        (_fill("system_mass"),),
    ),
    ProgramMistake(
        "all masses 1", "uses a mass of 1 kg for every vertex", "M_ii = m_i", (_fill("system_mass", "target_mass"),)
    ),
    ProgramMistake(
        "k left out of b",
        "leaves k out of the right-hand side",
        "b = k A'd + y",
        (_fill("side_stiffness"),),
    ),
    ProgramMistake("k left out of Q", "leaves k out of Q", "Q = k A'A + M/dt^2 + w C'C", (_fill("system_stiffness"),)),
    ProgramMistake(
        "wrong stiffness",
        "uses half or twice the stiffness",
        "the energy is k/2 (|v| - r)^2, so its gradient has k",
        tuple(_scale(system_stiffness=f, side_stiffness=f) for f in (0.5, 2.0)),
    ),
    ProgramMistake(
        "no inertia",
        "overwrites the previous positions by the current ones before the step, so that no velocity is left",
        "update p^(t-dt) after the step, from p^t",
        (_change(map_target=lambda q, p, before: p),),
    ),
    ProgramMistake(
        "y from the iterate",
        "computes y from the iterate in each iteration",
        "y is constant during a step; compute it before the iterations from p^t",
        (_change(uses_iterate=True),),
    ),
    ProgramMistake(
        "pins left out of Q",
        "leaves the pins out of Q",
        "Q = k A'A + M/dt^2 + w C'C",
        (_scale(system_weight=0.0),),
    ),
    ProgramMistake(
        "pins left out of b",
        "leaves the pins out of the right-hand side",
        "y ends in + w C'C p_rest",
        (_scale(side_weight=0.0),),
    ),
    ProgramMistake(
        "no pins",
        "leaves out the pins",
        "Q has + w C'C, and y has + w C'C p_rest",
        (_scale(system_weight=0.0, side_weight=0.0),),
    ),
    ProgramMistake(
        "pins with the wrong sign",
        "adds the penalty of the pins with the wrong sign",
        "the derivative of w/2 |C p - C p_rest|^2 is w C'C p - w C'C p_rest; its second part belongs to the other side",
        (_scale(side_weight=-1.0), _scale(system_weight=-1.0)),
    ),
    ProgramMistake(
        "other pins",
        "pins the vertices whose numbers are one too large or too small",
        "the pins of scene.json are counted from 1",
        (_shift_pins(1), _shift_pins(-1)),
    ),
    ProgramMistake(
        "d not normalised",
        "does not divide d by the length of the spring",
        "d_e = r_e v_e/|v_e|",
        (
            _change(compute_directions=lambda v, unit, rest, current: v),
            _change(compute_directions=lambda v, unit, rest, current: rest[:, None] * v),
        ),
    ),
    ProgramMistake(
        "d without rest lengths",
        "does not multiply d by the rest length",
        "d_e = r_e v_e/|v_e|",
        (
            _change(compute_directions=lambda v, unit, rest, current: unit),
            _change(compute_directions=lambda v, unit, rest, current: np.zeros_like(v)),
        ),
    ),
    ProgramMistake(
        "d with the wrong sign",
        "takes d in the opposite direction",
        "v_ij = p_i - p_j, with A_ei = +1 and A_ej = -1",
        (_change(compute_directions=lambda v, unit, rest, current: -rest[:, None] * unit),),
    ),
    ProgramMistake(
        "rest lengths of the current mesh",
        "takes the rest lengths from the positions at the start of each step",
        "r_e is the length at rest, computed once from V",
        (_change(compute_directions=lambda v, unit, rest, current: current[:, None] * unit),),
    ),
    ProgramMistake(
        "explicit step",
        "steps explicitly: the springs act at known positions, and no system is solved",
        "implicit Euler minimises over the new positions",
        (_change(explicit_at="current"), _change(explicit_at="previous")),
    ),
    ProgramMistake("axes swapped", "writes the coordinates in another order", "the order is x, y, z", axes=AXES[1:]),
    ProgramMistake(
        "one frame late",
        "writes each frame one step late",
        "write p^(t+dt) after the step, not p^t before it; a file that begins with the start needs --first-frame 0",
        is_late=True,
    ),
)
"""Known mistakes. A wrong time step and a wrong number of iterations are fitted instead."""
