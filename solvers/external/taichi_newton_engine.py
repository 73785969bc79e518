"""Taichi: implicit Euler in substeps by Newton's method with conjugate gradients (`taichi_program`).

Taichi is a language without a solver of spring networks. The program is written here, in the style of Taichi's
examples. Its kernels are compiled during preparation, for one core, and cached by Taichi.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from springbench.solvers.external import taichi_program
from springbench.solvers.external.external_engine import (
    EngineNetwork,
    EnginePackage,
    ExternalEngine,
    PreparedEngine,
    ScriptFrames,
    interpolate_pins,
)
from springbench.solvers.iteration.solver_info import ENGINE_FAMILY, Citation, SolverInfo
from springbench.solvers.model.step_problem import Positions, StepProblem, System, Unsupported

_SCRIPT_TEMPLATE = """\


import time

import taichi as ti

net = np.load("{name}.npz")  # the network, and where springbench's run ended
ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f64)
arrays = (net[key] for key in ("mass", "pinned", "ends", "stiffness", "rest_length"))
made = build_taichi_program(ti, *arrays, {tolerance!r})
made.h[None], made.newton[None] = {h!r}, {newton}
for field, key in ((made.x, "positions"), (made.v, "velocities"), (made.load, "force")):
    field.from_numpy(net[key])
began = time.perf_counter()  # the first step compiles
{loop}seconds, p = time.perf_counter() - began, made.x.to_numpy()
print(f"{{seconds:.3g}} s; {{abs(p - net['end']).max():.3g}} m from the end of that run")
"""

_PLAIN_LOOP = """\
for _ in range({steps}):
    made.step()
"""

_DRIVEN_LOOP = """\
for begin, end in zip(net["pins"], net["pins"][1:]):  # {frames} frames
    for k in range({substeps}):
        x = made.x.to_numpy()
        x[net["pinned"]] = begin + k / {substeps} * (end - begin) + (end - begin) / {substeps}
        made.x.from_numpy(x)
        made.step()
    made.v.from_numpy({factor!r} * made.v.to_numpy())  # drag
"""


@dataclass(frozen=True)
class TaichiNewtonEngine(ExternalEngine):
    """Newton's method with conjugate gradients in Taichi.

    Args:
        iterations_per_substep: Newton iterations; one equals Baraff and Witkin's linearised step.
        cg_rtol: tolerance of conjugate gradients, relative to the gradient.
    """

    solver_name: ClassVar[str] = "taichi"
    engine_package: ClassVar[EnginePackage] = EnginePackage("taichi", "taichi", "taichi")
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        ENGINE_FAMILY,
        Citation(
            "Hu, Yuanming and Li, Tzu-Mao and Anderson, Luke and Ragan-Kelley, Jonathan and Durand, Frédo",
            2019,
            "Taichi: a language for high-performance computation on spatially sparse data structures",
            "10.1145/3355089.3356506",
        ),
        is_substepping=True,
        package_name="taichi",
        formula="implicit Euler by Newton-CG, written in Taichi",
        cost="1 engine substep",
    )

    iterations_per_substep: int = 1
    cg_rtol: float = 1e-6

    def prepare(self, system: System) -> PreparedEngine:
        """Prepare the engine for a system; raise Unsupported for unsupported features."""
        os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
        return super().prepare(system)

    def build_stepper(self, network: EngineNetwork, library: Any) -> tuple[_TaichiStepper, str]:
        """Compile the Taichi program of the network.

        Args:
            network: masses, springs and pins in the form that engines support.
            library: the imported module `taichi`.

        Returns:
            The stepper, and a description with the number of iterations.

        Raises:
            Unsupported: for less than one iteration, and a tolerance outside (0, 1).
        """
        if not self.iterations_per_substep >= 1:
            raise Unsupported(f"taichi: iterations_per_substep is {self.iterations_per_substep}; expected 1 or more")
        if not 0.0 < self.cg_rtol < 1.0:
            raise Unsupported(f"taichi: cg_rtol is {self.cg_rtol}; expected a part of the gradient, such as 1e-6")
        made = _TaichiStepper(library, network, self.iterations_per_substep, self.cg_rtol)
        return made, f"{self.iterations_per_substep} iterations of Newton's method a substep, in float64, on one thread"

    def write_script(
        self, file_stem: str, network: EngineNetwork, problem: StepProblem, frames: ScriptFrames
    ) -> dict[str, str]:
        """Return a script that repeats a motion from a step's start with the engine only.

        Args:
            file_stem: NAME of the files.
            network: the network, for its time step; the script reads its arrays from `NAME.npz`.
            problem: not used; the script reads the start and the load from `NAME.npz`.
            frames: frames and their substeps.

        Returns:
            The text of `NAME.py`, by file name.
        """
        given = {"tolerance": self.cg_rtol, "newton": self.iterations_per_substep}
        given |= {"h": network.time_step / frames.num_substeps, "loop": frames.format_loop(_PLAIN_LOOP, _DRIVEN_LOOP)}
        driver = _SCRIPT_TEMPLATE.format(name=file_stem, **given)
        return {f"{file_stem}.py": Path(taichi_program.__file__).read_text(encoding="utf-8") + driver}


@cache
def _initialise_taichi(library: Any) -> None:
    """Initialise Taichi once per process: a second time, it would discard all existing data."""
    library.init(arch=library.cpu, cpu_max_num_threads=1, default_fp=library.f64, log_level=library.WARN)


class _TaichiStepper:
    """The Taichi program of a network."""

    def __init__(self, library: Any, network: EngineNetwork, iterations: int, tolerance: float) -> None:
        _initialise_taichi(library)
        lines = network.spring_dashpots
        arrays = network.mass, network.pinned_vertices, lines.ends, lines.stiffness, lines.rest_length
        self._network, self._made = network, taichi_program.build_taichi_program(library, *arrays, tolerance)
        self._made.h[None], self._made.newton[None] = network.time_step, 0
        self._made.step()  # compiles
        self._made.newton[None] = iterations

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in `substeps` substeps; return positions [m] and velocities [m/s] at its end."""
        net, made, start = self._network, self._made, problem.step_start
        for field, values in ((made.x, start.positions), (made.v, start.velocity), (made.load, problem.external_force)):
            field.from_numpy(values)
        made.h[None] = net.time_step / substeps
        begin, end = start.positions[net.pinned_vertices], problem.pin_targets
        places = interpolate_pins(begin, end, substeps)
        for k in range(substeps):
            if places is not None:
                p = made.x.to_numpy()
                p[net.pinned_vertices] = places[k] + (end - begin) / substeps
                made.x.from_numpy(p)
            made.step()
        p, v = made.x.to_numpy(), made.v.to_numpy()
        p[net.pinned_vertices], v[net.pinned_vertices] = end, (end - begin) / net.time_step
        return p, v
