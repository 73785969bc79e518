"""Newton (Warp): particle springs, stepped by three of its solvers in float32.

It runs on the CPU or on a CUDA device.

- `vbd`, vertex block descent (Chen et al. 2024), and `xpbd`: implicit Euler in substeps with several iterations each.
  Newton's `ModelBuilder.color` considers triangles, tetrahedra and bending edges, but no springs: a spring network has
  one colour, so all its vertices move simultaneously, which diverges for stiff springs. Colours of the springs are
  therefore set by `set_coloring`, unless `colouring_source` selects Newton's.
- Newton's XPBD projects all springs simultaneously, without relaxation, and discards multipliers between iterations. It
  converges to C = 0, whatever the stiffness of the springs (issue 2933 of newton-physics/newton). Only one iteration
  per substep therefore corresponds to XPBD.
- `semi-implicit`: v <- v + h M^-1 f(p), p <- p + h v.

Its documentation recommends more substeps for stiff springs ("Tuning VBD"). Its example of a hanging cloth uses 10
substeps of a frame of 1/60 s, with 10 iterations each, for VBD and XPBD, and 32 explicit substeps. Kernels are
compiled during preparation, which takes a minute the first time, and cached by Warp. Style3D, its fourth cloth solver,
supports triangles but no springs.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.external.external_engine import (
    EngineNetwork,
    EnginePackage,
    ExternalEngine,
    PreparedEngine,
    ScriptFrames,
    interpolate_pins,
)
from springbench.solvers.iteration.device_interface import DeviceOptions
from springbench.solvers.iteration.solver_info import ENGINE_FAMILY, Citation, SolverInfo
from springbench.solvers.methods.vertex_block.colouring import colour_vertices
from springbench.solvers.model.step_problem import Positions, StepProblem, System, Unsupported

NewtonSolverName = Literal["vbd", "xpbd", "semi-implicit"]
ColouringSource = Literal["springs", "newton"]

_SCRIPT_TEMPLATE = """\
import time
import newton
import numpy as np
net = np.load("{name}.npz")  # the network, and where springbench's run of Newton ended
builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
pinned = set(net["pinned"].tolist())
for i, (p, v, m) in enumerate(zip(net["positions"], net["velocities"], net["mass"])):
    builder.add_particle(p, 0.0 * v if i in pinned else v, 0.0 if i in pinned else m, radius=0.0)
for (i, j), k in zip(net["ends"].tolist(), net["stiffness"]):
    builder.add_spring(i, j, k, 0.0, control=0.0)
builder.spring_rest_length = net["rest_length"].tolist()
{colouring}model = builder.finalize(device="{device}")
solver, now, then, h = newton.solvers.{solver}, model.state(), model.state(), {h!r}
began = time.perf_counter()  # the first step compiles
{loop}seconds, p = time.perf_counter() - began, now.particle_q.numpy()
print(f"{{seconds:.3g}} s; {{abs(p - net['end']).max():.3g}} m from the end of that run")
"""

_PLAIN_LOOP = """\
for _ in range({steps}):
    now.particle_f.assign(net["force"].astype(np.float32))
    solver.step(now, then, None, None, h)
    now, then = then, now
"""

_DRIVEN_LOOP = """\
pinned = net["pinned"]
for begin, end in zip(net["pins"], net["pins"][1:]):  # {frames} frames
    for k in range({substeps}):
        q = now.particle_q.numpy()
        q[pinned] = begin + k / {substeps} * (end - begin)AHEAD
        now.particle_q.assign(q), now.particle_f.assign(net["force"].astype(np.float32))
        solver.step(now, then, None, None, h)
        now, then = then, now
    for state in (now, then):
        v = {factor!r} * state.particle_qd.numpy().astype(float)  # drag
        v[pinned] = 0.0
        state.particle_qd.assign(v.astype(np.float32))
"""


@dataclass(frozen=True)
class NewtonPhysicsEngine(ExternalEngine, DeviceOptions):
    """Newton physics engine.

    Args:
        newton_solver: one of Newton's solvers.
        iterations_per_substep: number of iterations; unused by the explicit solver.
        colouring_source: colours of the vertices, which `vbd` moves simultaneously: of the springs, or Newton's own.
        device: `cpu` or `cuda`.
    """

    solver_name: ClassVar[str] = "newton-physics"
    engine_package: ClassVar[EnginePackage] = EnginePackage("newton", "newton", "newton")
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        ENGINE_FAMILY,
        Citation("{Newton Contributors}", 2025, "Newton: an open-source, GPU-accelerated physics simulation engine"),
        is_substepping=True,
        package_name="newton",
        formula="Newton on Warp: VBD, XPBD or semi-implicit Euler",
        cost="1 engine substep",
    )

    newton_solver: NewtonSolverName = "vbd"
    iterations_per_substep: int = 10
    colouring_source: ColouringSource = "springs"

    def prepare(self, system: System) -> PreparedEngine:
        """Prepare the engine for a system; raise Unsupported for unsupported features."""
        with suppress(ImportError):  # `super().prepare` reports it
            warp = import_module("warp")
            warp.config.log_level = warp.LOG_ERROR  # otherwise it logs devices and each compiled module
        return super().prepare(system)

    def build_stepper(self, network: EngineNetwork, library: Any) -> tuple[_NewtonPhysicsStepper, str]:
        """Build the network as particles and springs of a Newton model.

        Args:
            network: masses, springs and pins in the form that engines support.
            library: the imported module `newton`.

        Returns:
            The stepper, and a description with the solver, its iterations or colours, and the device.

        Raises:
            Unsupported: for less than one iteration, and if Warp finds no CUDA device although one is requested.
        """
        if not self.iterations_per_substep >= 1:
            raise Unsupported(
                f"newton-physics: iterations_per_substep is {self.iterations_per_substep}; expected 1 or more"
            )
        warp = import_module("warp")
        if self.device == "cuda" and not warp.is_cuda_available():
            raise Unsupported("newton-physics: device: cuda: Warp finds no CUDA device, or no driver for it")
        builder = library.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        fixed = np.isin(np.arange(len(network.mass)), network.pinned_vertices)
        for m in np.where(fixed, 0.0, network.mass).tolist():
            builder.add_particle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), m, radius=0.0)  # without radius, no contact
        for (i, j), k in zip(
            network.spring_dashpots.ends.tolist(), network.spring_dashpots.stiffness.tolist(), strict=True
        ):
            builder.add_spring(i, j, k, 0.0, control=0.0)
        builder.spring_rest_length = network.spring_dashpots.rest_length.tolist()
        description = "explicit"
        if self.newton_solver != "semi-implicit":
            description = f"{self.iterations_per_substep} iterations a substep"
        if self.newton_solver == "vbd":
            description += f", {self._set_colouring(builder, network)} colours"
        model = builder.finalize(device=self.device)
        solver, explicit = self._build_solver(library.solvers, model), self.newton_solver == "semi-implicit"
        made = _NewtonPhysicsStepper(warp, model, solver, network, explicit=explicit)
        where = f"the device {model.device.name}" if self.device == "cuda" else "the CPU, on one thread"
        return made, f"{self.newton_solver}, {description}, in float32 on {where}"

    def _set_colouring(self, builder: Any, network: EngineNetwork) -> int:
        """Set the colours; return their number."""
        if self.colouring_source == "newton":
            builder.color()
        else:
            found = colour_vertices(network.spring_dashpots.ends, len(network.mass))
            builder.set_coloring(np.split(found.item_order, found.colour_starts[1:-1]))
        return len(builder.particle_color_groups)

    def _build_solver(self, solvers: Any, model: Any) -> Any:
        if self.newton_solver == "semi-implicit":
            return solvers.SolverSemiImplicit(model)
        return {"vbd": solvers.SolverVBD, "xpbd": solvers.SolverXPBD}[self.newton_solver](
            model, iterations=self.iterations_per_substep
        )

    def write_script(
        self, file_stem: str, network: EngineNetwork, problem: StepProblem, frames: ScriptFrames
    ) -> dict[str, str]:
        """Return a script that repeats a motion from a step's start with the engine only.

        Args:
            file_stem: NAME of the files.
            network: the network, for its time step and the colours of its vertices.
            problem: not used; the script reads the start and the load from `NAME.npz`.
            frames: frames and their substeps.

        Returns:
            The text of `NAME.py`, by file name.
        """
        made = {
            "vbd": f"SolverVBD(model, iterations={self.iterations_per_substep})",
            "xpbd": f"SolverXPBD(model, iterations={self.iterations_per_substep})",
            "semi-implicit": "SolverSemiImplicit(model)",
        }
        colouring, ahead = "", "" if self.newton_solver == "semi-implicit" else " + (end - begin) / {substeps}"
        if self.newton_solver == "vbd" and self.colouring_source == "newton":
            colouring = "builder.color()\n"
        elif self.newton_solver == "vbd":
            found = colour_vertices(network.spring_dashpots.ends, len(network.mass))
            groups = [group.tolist() for group in np.split(found.item_order, found.colour_starts[1:-1])]
            colouring = f"builder.set_coloring({groups})  # no two of a colour share a spring\n"
        text = _SCRIPT_TEMPLATE.format(
            name=file_stem,
            colouring=colouring,
            device=self.device,
            solver=made[self.newton_solver],
            h=network.time_step / frames.num_substeps,
            loop=frames.format_loop(_PLAIN_LOOP, _DRIVEN_LOOP.replace("AHEAD", ahead)),
        )
        return {f"{file_stem}.py": text}


class _NewtonPhysicsStepper:
    """A model, its solver and two alternating states.

    On the CPU, the arrays of the states are accessed in place.
    """

    def __init__(self, warp: Any, model: Any, solver: Any, network: EngineNetwork, *, explicit: bool) -> None:
        self._warp, self._solver, self._network, self._explicit = warp, solver, network, explicit
        self._current_state, self._next_state = model.state(), model.state()
        self._external_force = warp.zeros_like(self._current_state.particle_f)
        solver.step(
            self._current_state, self._next_state, None, None, network.time_step
        )  # compiles; each step sets its own state

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in `substeps` substeps; return positions [m] and velocities [m/s] at its end."""
        net, start, h = self._network, problem.step_start, self._network.time_step / substeps
        _write_array(self._current_state.particle_q, start.positions)
        _write_array(self._current_state.particle_qd, start.velocity)
        for state in (self._current_state, self._next_state):
            _write_array(
                state.particle_qd, 0.0, net.pinned_vertices
            )  # otherwise a massless particle would move at its velocity
        _write_array(self._external_force, problem.external_force)
        begin, end = start.positions[net.pinned_vertices], problem.pin_targets
        places = interpolate_pins(begin, end, substeps)
        ahead = 0.0 if self._explicit else (end - begin) / substeps  # implicit: pins at the end of the substep
        for k in range(substeps):
            if places is not None:
                _write_array(self._current_state.particle_q, places[k] + ahead, net.pinned_vertices)
            self._warp.copy(
                self._current_state.particle_f, self._external_force
            )  # an explicit step adds the springs' forces to it
            self._solver.step(self._current_state, self._next_state, None, None, h)
            self._current_state, self._next_state = self._next_state, self._current_state
        p, v = (
            np.array(array.numpy(), np.float64)
            for array in (self._current_state.particle_q, self._current_state.particle_qd)
        )
        p[net.pinned_vertices], v[net.pinned_vertices] = end, (end - begin) / net.time_step
        return p, v


def _write_array(array: Any, values: NDArray[np.float64] | float, rows: NDArray[np.int64] | None = None) -> None:
    """Write values to a Warp array (n, 3), or to some of its rows."""
    if rows is None and array.device.is_cuda:
        array.assign(np.asarray(values, np.float32))
        return
    host = array.numpy()  # on the CPU this is a view of the array, on a device a copy
    host[slice(None) if rows is None else rows] = values
    if array.device.is_cuda:
        array.assign(host)
