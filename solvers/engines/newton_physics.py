"""Newton (Warp): particle springs, stepped by three of its solvers in float32, on the CPU or a CUDA device.

- `vbd`, vertex block descent (Chen et al. 2024), and `xpbd`: implicit Euler in substeps with several iterations each.
  Newton's `ModelBuilder.color` considers triangles, tetrahedra and bending edges, but no springs: a spring network has
  one colour, so all its vertices move simultaneously, which diverges for stiff springs. Colours of the springs are
  therefore set by `set_coloring`, unless `colours` selects Newton's.
- Newton's XPBD projects all springs simultaneously, without relaxation, and discards multipliers between iterations. It
  converges to C = 0, whatever the stiffness of the springs (issue 2933 of newton-physics/newton). Only one iteration
  per substep therefore corresponds to XPBD.
- `semi-implicit`: v <- v + h M^-1 f(p), p <- p + h v.

Its documentation handles stiff springs by more substeps ("Tuning VBD"). Its example of a hanging cloth uses 10 substeps
of a frame of 1/60 s, with 10 iterations each, for VBD and XPBD, and 32 explicit substeps. Kernels are compiled during
preparation, which takes a minute the first time, and cached by Warp. Style3D, its fourth cloth solver, supports
triangles but no springs.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from solvers.about import ENGINE, About, Reference
from solvers.core.colouring import of_vertices
from solvers.device import OnDevice
from solvers.engines.base import Engine, Network, Package, PreparedEngine, evenly
from solvers.problem import Positions, StepProblem, System, Unsupported

Method = Literal["vbd", "xpbd", "semi-implicit"]
Colours = Literal["springs", "newton"]

_SCRIPT = """\
import time
import newton
import numpy as np
net = np.load("{name}.npz")  # the network, and where springbench's run of Newton ended
builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
held = set(net["pinned"].tolist())
for i, (p, v, m) in enumerate(zip(net["positions"], net["velocities"], net["mass"])):
    builder.add_particle(p, 0.0 * v if i in held else v, 0.0 if i in held else m, radius=0.0)
for (i, j), k in zip(net["ends"].tolist(), net["stiffness"]):
    builder.add_spring(i, j, k, 0.0, control=0.0)
builder.spring_rest_length = net["rest_length"].tolist()
{colouring}model = builder.finalize(device="{device}")
solver, now, then = newton.solvers.{solver}, model.state(), model.state()
began = time.perf_counter()  # the first step compiles
for _ in range({steps}):
    now.particle_f.assign(net["force"].astype(np.float32))
    solver.step(now, then, None, None, {h!r})
    now, then = then, now
seconds, p = time.perf_counter() - began, now.particle_q.numpy()
print(f"{{seconds:.3g}} s; {{abs(p - net['end']).max():.3g}} m from the end of that run")
"""


@dataclass(frozen=True)
class NewtonPhysics(Engine, OnDevice):
    """Newton physics engine.

    Args:
        method: one of Newton's solvers.
        iterations: number of iterations; unused by the explicit solver.
        colours: vertices that `vbd` moves simultaneously: by springs, or Newton's colouring.
        device: as for the other solvers.
    """

    name: ClassVar[str] = "newton-physics"
    package: ClassVar[Package] = Package("newton", "newton", "newton")
    about: ClassVar[About] = About(
        ENGINE,
        Reference("{Newton Contributors}", 2025, "Newton: an open-source, GPU-accelerated physics simulation engine"),
        own_steps=True,
        package="newton",
    )

    method: Method = "vbd"
    iterations: int = 10
    colours: Colours = "springs"

    def prepare(self, system: System) -> PreparedEngine:
        """Prepare the engine for a system; raise Unsupported for unsupported features."""
        with suppress(ImportError):  # which is told where Newton is asked for
            warp = import_module("warp")
            warp.config.log_level = warp.LOG_ERROR  # it tells of devices and of each module that it compiles
        return super().prepare(system)

    def built(self, network: Network, library: Any) -> tuple[_Model, str]:
        """Build the network in the engine; return its stepper and a description."""
        if not self.iterations >= 1:
            raise Unsupported(f"newton-physics: iterations came as {self.iterations}; wanted 1 or more")
        warp = import_module("warp")
        if self.device == "cuda" and not warp.is_cuda_available():
            raise Unsupported("newton-physics: device: cuda: Warp finds no CUDA device, or no driver for it")
        builder = library.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        fixed = np.isin(np.arange(len(network.mass)), network.pinned)
        for m in np.where(fixed, 0.0, network.mass).tolist():
            builder.add_particle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), m, radius=0.0)  # without radius, no contact
        for (i, j), k in zip(network.lines.ends.tolist(), network.lines.stiffness.tolist(), strict=True):
            builder.add_spring(i, j, k, 0.0, control=0.0)
        builder.spring_rest_length = network.lines.rest_length.tolist()
        told = "explicit"
        if self.method != "semi-implicit":
            told = f"{self.iterations} iterations a substep"
        if self.method == "vbd":
            told += f", {self._colour(builder, network)} colours"
        model = builder.finalize(device=self.device)
        solver, explicit = self._solver(library.solvers, model), self.method == "semi-implicit"
        made = _Model(warp, model, solver, network, explicit=explicit)
        where = f"the device {model.device.name}" if self.device == "cuda" else "the CPU, on one thread"
        return made, f"{self.method}, {told}, in float32 on {where}"

    def _colour(self, builder: Any, network: Network) -> int:
        """Set the colours; return their number."""
        if self.colours == "newton":
            builder.color()
        else:
            found = of_vertices(network.lines.ends, len(network.mass))
            builder.set_coloring(np.split(found.order, found.start[1:-1]))
        return len(builder.particle_color_groups)

    def _solver(self, solvers: Any, model: Any) -> Any:
        if self.method == "semi-implicit":
            return solvers.SolverSemiImplicit(model)
        return {"vbd": solvers.SolverVBD, "xpbd": solvers.SolverXPBD}[self.method](model, iterations=self.iterations)

    def script(self, name: str, network: Network, problem: StepProblem, substeps: int, frames: int) -> dict[str, str]:
        """Return scripts that repeat a motion from a step's start with the engine only, by file name."""
        made = {
            "vbd": f"SolverVBD(model, iterations={self.iterations})",
            "xpbd": f"SolverXPBD(model, iterations={self.iterations})",
            "semi-implicit": "SolverSemiImplicit(model)",
        }
        colouring = ""
        if self.method == "vbd" and self.colours == "newton":
            colouring = "builder.color()\n"
        elif self.method == "vbd":
            found = of_vertices(network.lines.ends, len(network.mass))
            groups = [group.tolist() for group in np.split(found.order, found.start[1:-1])]
            colouring = f"builder.set_coloring({groups})  # no two of a colour share a spring\n"
        text = _SCRIPT.format(
            name=name,
            colouring=colouring,
            device=self.device,
            solver=made[self.method],
            steps=substeps * frames,
            h=network.time_step / substeps,
        )
        return {f"{name}.py": text}


class _Model:
    """A model, its solver and two alternating states. On the CPU its arrays are accessed in place."""

    def __init__(self, warp: Any, model: Any, solver: Any, network: Network, *, explicit: bool) -> None:
        self._warp, self._solver, self._network, self._explicit = warp, solver, network, explicit
        self._now, self._then = model.state(), model.state()
        self._load = warp.zeros_like(self._now.particle_f)
        solver.step(self._now, self._then, None, None, network.time_step)  # compiles; each step sets its own state

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in `substeps` substeps; return positions [m] and velocities [m/s] at its end."""
        net, start, h = self._network, problem.start, self._network.time_step / substeps
        _set(self._now.particle_q, start.positions)
        _set(self._now.particle_qd, start.velocity)
        for state in (self._now, self._then):
            _set(state.particle_qd, 0.0, net.pinned)  # a particle without mass would go on with what it has
        _set(self._load, problem.force)
        begin, end = start.positions[net.pinned], problem.pin_targets
        places = evenly(begin, end, substeps)
        ahead = 0.0 if self._explicit else (end - begin) / substeps  # implicit steps have pins where they will be
        for k in range(substeps):
            if places is not None:
                _set(self._now.particle_q, places[k] + ahead, net.pinned)
            self._warp.copy(self._now.particle_f, self._load)  # an explicit step adds the springs' forces to it
            self._solver.step(self._now, self._then, None, None, h)
            self._now, self._then = self._then, self._now
        p, v = (np.array(array.numpy(), np.float64) for array in (self._now.particle_q, self._now.particle_qd))
        p[net.pinned], v[net.pinned] = end, (end - begin) / net.time_step
        return p, v


def _set(array: Any, values: NDArray[np.float64] | float, rows: NDArray[np.int64] | None = None) -> None:
    """Write values to a Warp array (n, 3), or to some of its rows."""
    if rows is None and array.device.is_cuda:
        array.assign(np.asarray(values, np.float32))
        return
    host = array.numpy()  # on the CPU the array itself
    host[slice(None) if rows is None else rows] = values
    if array.device.is_cuda:
        array.assign(host)
