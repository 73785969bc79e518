"""PositionBasedDynamics through its Python interface pyPBD: springs are its XPBD distance constraints.

    lambda' = -(C + lambda / (k h^2)) / (1/m_i + 1/m_j + 1/(k h^2)),    C = |p_i - p_j| - r

(Macklin, Mueller and Chentanez 2016), in the substeps h of its `TimeStepController`, each with several iterations over
all constraints. Its documentation and examples use substeps rather than iterations for stiff cloth, after Macklin
et al. 2019: by default a time step of 5 ms has 5 substeps of one iteration each. Gravity is its only force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numba
import numpy as np
from springbench.solvers.external.external_engine import (
    EngineNetwork,
    EnginePackage,
    ExternalEngine,
    ScriptFrames,
    interpolate_pins,
)
from springbench.solvers.iteration.solver_info import ENGINE_FAMILY, Citation, SolverInfo
from springbench.solvers.model.step_problem import Positions, StepProblem, Unsupported
from threadpoolctl import ThreadpoolController  # pyright: ignore[reportMissingTypeStubs]

_SCRIPT_TEMPLATE = """\
import time
import numpy as np
import pypbd as pbd
net = np.load("{name}.npz")  # the network, and where springbench's run of pyPBD ended
sim, model, control = pbd.Simulation.getCurrent(), pbd.SimulationModel(), pbd.TimeStepController()
model.init(), control.init(), pbd.TimeManager.getCurrent().setTimeStepSize({time_step!r})
control.setValueUInt(pbd.TimeStepController.NUM_SUB_STEPS, {substeps})
control.setValueUInt(pbd.TimeStepController.MAX_ITERATIONS, {iterations})
control.setValueUInt(pbd.TimeStepController.MAX_ITERATIONS_V, 0)
control.setValueInt(pbd.TimeStepController.VELOCITY_UPDATE_METHOD, pbd.TimeStepController.ENUM_VUPDATE_FIRST_ORDER)
particles, pinned = model.getParticles(), set(net["pinned"].tolist())
for i, (p, v, m) in enumerate(zip(net["positions"], net["velocities"], net["mass"])):
    particles.addVertex(p), particles.setMass(i, 0.0 if i in pinned else m), particles.setVelocity(i, v)
for (i, j), k, r in zip(net["ends"].tolist(), net["stiffness"], net["rest_length"]):
    model.addDistanceConstraint_XPBD(i, j, k)
    model.getConstraints()[-1].restLength = r
began = time.perf_counter()
{loop}seconds, p = time.perf_counter() - began, np.array(particles.getVertices())
print(f"{{seconds:.3g}} s; {{abs(p - net['end']).max():.3g}} m from the end of that run")
"""

_PLAIN_LOOP = """\
for _ in range({frames}):
    control.step(model)
"""

_DRIVEN_LOOP = """\
for begin, end in zip(net["pins"], net["pins"][1:]):  # {frames} frames
    for k in range({substeps}):  # each a step of one substep
        for i, x in zip(net["pinned"].tolist(), begin + k / {substeps} * (end - begin) + (end - begin) / {substeps}):
            particles.setPosition(i, x)
        control.step(model)
    for i in range(len(net["mass"])):
        particles.setVelocity(i, {factor!r} * particles.getVelocity(i))  # drag
"""


@dataclass(frozen=True)
class PyPbdEngine(ExternalEngine):
    """PositionBasedDynamics.

    Args:
        iterations_per_substep: iterations over all constraints in each substep.
    """

    solver_name: ClassVar[str] = "pypbd"
    engine_package: ClassVar[EnginePackage] = EnginePackage("pypbd", "pyPBD", "pypbd")
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        ENGINE_FAMILY,
        Citation(
            "Bender, Jan and Müller, Matthias and Macklin, Miles",
            2017,
            "A survey on position based dynamics",
            "10.2312/egt.20171034",
        ),
        is_substepping=True,
        package_name="pyPBD",
        formula="PositionBasedDynamics: XPBD distance constraints",
        cost="1 engine substep",
    )

    iterations_per_substep: int = 1

    def build_stepper(self, network: EngineNetwork, library: Any) -> tuple[_PyPbdStepper, str]:
        """Build the network as particles and distance constraints of pyPBD.

        Args:
            network: masses, springs and pins in the form that engines support.
            library: the imported module `pypbd`.

        Returns:
            The stepper, and a description with the number of iterations and the precision.

        Raises:
            Unsupported: for less than one iteration.
        """
        if not self.iterations_per_substep >= 1:
            raise Unsupported(f"pypbd: iterations_per_substep is {self.iterations_per_substep}; expected 1 or more")
        made = _PyPbdStepper(library, network, self.iterations_per_substep)
        return made, f"{self.iterations_per_substep} iterations a substep, in {made.precision}"

    def write_script(
        self, file_stem: str, network: EngineNetwork, problem: StepProblem, frames: ScriptFrames
    ) -> dict[str, str]:
        """Return a script that repeats a motion from a step's start with the engine only.

        Args:
            file_stem: NAME of the files.
            network: the network, for its time step and the check of the load.
            problem: the step whose load must be the engine's gravity.
            frames: frames and their substeps.

        Returns:
            The text of `NAME.py`, by file name.

        Raises:
            Unsupported: for loads other than `PYPBD_GRAVITY`.
        """
        _require_gravity(network, problem)
        pieces = frames.num_substeps if frames.is_driven else 1  # engine steps per frame; pins move only between steps
        given = {
            "time_step": network.time_step / pieces,
            "substeps": frames.num_substeps // pieces,
            "iterations": self.iterations_per_substep,
            "loop": frames.format_loop(_PLAIN_LOOP, _DRIVEN_LOOP),
        }
        return {f"{file_stem}.py": _SCRIPT_TEMPLATE.format(name=file_stem, **given)}


PYPBD_GRAVITY = (0.0, -9.81, 0.0)
"""Gravity of pyPBD, the only value that its interface supports [m/s^2]."""


def _require_gravity(network: EngineNetwork, problem: StepProblem) -> None:
    found = network.uniform_acceleration(problem.external_force)
    if found is None or not np.allclose(found, PYPBD_GRAVITY, rtol=0.0, atol=1e-9):
        found_loads = "loads of another kind" if found is None else f"({', '.join(f'{x:g}' for x in found)}) m/s²"
        raise Unsupported(f"pypbd: has gravity of 9.81 m/s² along -y and no other force; the scene has {found_loads}")


def _limit_openmp_threads() -> None:
    """Limit the engine's OpenMP threads to the number of threads of our kernels."""
    for pool in ThreadpoolController().select(internal_api="openmp").lib_controllers:
        if "pypbd" in pool.filepath:
            pool.set_num_threads(numba.get_num_threads())


class _PyPbdStepper:
    """A pyPBD model and its state.

    Only vertices that differ from the previous final state are set, one by one.
    """

    def __init__(self, library: Any, network: EngineNetwork, iterations: int) -> None:
        self._library, self._network = library, network
        _limit_openmp_threads()
        library.Simulation.getCurrent()  # creates the simulation, which contains gravity
        self._model, self._control = library.SimulationModel(), library.TimeStepController()
        self._model.init()
        self._control.init()
        self._particles = self._model.getParticles()
        fixed = np.isin(np.arange(len(network.mass)), network.pinned_vertices)
        for i, m in enumerate(np.where(fixed, 0.0, network.mass).tolist()):
            self._particles.addVertex(np.zeros(3))
            self._particles.setMass(i, m)
        for (i, j), k in zip(
            network.spring_dashpots.ends.tolist(), network.spring_dashpots.stiffness.tolist(), strict=True
        ):
            self._model.addDistanceConstraint_XPBD(i, j, k)
        constraints = self._model.getConstraints()
        for e, r in enumerate(network.spring_dashpots.rest_length.tolist()):
            constraints[e].restLength = r
        self._set_control(iterations, "MAX_ITERATIONS")
        self._set_control(0, "MAX_ITERATIONS_V")  # the network has no velocity constraints
        control = library.TimeStepController
        self._control.setValueInt(control.VELOCITY_UPDATE_METHOD, control.ENUM_VUPDATE_FIRST_ORDER)
        self._velocity = np.zeros((len(network.mass), 3))
        self.precision = f"float{8 * np.asarray(self._particles.getVertices()).itemsize}"

    def _set_control(self, value: int, name: str) -> None:
        self._control.setValueUInt(getattr(self._library.TimeStepController, name), value)

    def _read_positions(self) -> Positions:
        return np.array(self._particles.getVertices(), np.float64)

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step; raise Unsupported for loads other than its gravity."""
        net, start, particles = self._network, problem.step_start, self._particles
        _require_gravity(net, problem)
        for i in np.flatnonzero((self._read_positions() != start.positions).any(axis=1)).tolist():
            particles.setPosition(i, start.positions[i])
        for i in np.flatnonzero((self._velocity != start.velocity).any(axis=1)).tolist():
            particles.setVelocity(i, start.velocity[i])
        begin, end = start.positions[net.pinned_vertices], problem.pin_targets
        places = interpolate_pins(begin, end, substeps)
        h = net.time_step / substeps
        if places is None:
            self._run_substeps(h, substeps - 1)
            before = self._read_positions()
            self._run_substeps(h, 1)
        else:
            before = start.positions
            for place in places:
                before = self._read_positions()
                for i, x in zip(net.pinned_vertices.tolist(), place + (end - begin) / substeps, strict=True):
                    particles.setPosition(i, x)
                self._run_substeps(h, 1)
        p = self._read_positions()
        v = (1.0 / h) * (p - before)  # bitwise as pyPBD stores them; reading them takes a call per vertex
        v[net.pinned_vertices] = 0.0
        self._velocity = v.copy()
        p[net.pinned_vertices], v[net.pinned_vertices] = end, (end - begin) / net.time_step
        return p, v

    def _run_substeps(self, h: float, number: int) -> None:
        """Run substeps of h [s]."""
        if number:
            self._library.TimeManager.getCurrent().setTimeStepSize(h * number)
            self._set_control(number, "NUM_SUB_STEPS")
            self._control.step(self._model)
