"""MuJoCo: vertices are bodies on three slide joints, springs and dashpots are spatial tendons.

    M a = f - sum of (k (l - r) + c dl/dt) along the tendons - drag v

`Euler`, `implicitfast` and `implicit` are explicit in the positions, and implicit in the damping within the sparsity
pattern of M: v <- v + h M^^-1 M a, p <- p + h v, M^ = M - h D. In `Euler`, D contains only drag; in the others it also
contains each body's own part of the tendon damping. The coupling between bodies of different trees, as here, is
outside of that pattern. So with springs all three, and `RK4`, are stable while omega h is below about 2 (2.8 for RK4).
The documentation recommends a shorter time step in that case, `implicitfast` for most models, and `RK4` for
energy-conserving ones (Computation, "Numerical integration", "Choosing timestep and integrator").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.external.external_engine import (
    EngineNetwork,
    EnginePackage,
    ExternalEngine,
    ScriptFrames,
    interpolate_pins,
)
from springbench.solvers.iteration.solver_info import ENGINE_FAMILY, Citation, SolverInfo
from springbench.solvers.model.step_problem import Positions, StepProblem, Unsupported

MujocoIntegrator = Literal["implicitfast", "implicit", "Euler", "RK4"]

_MIN_MASS = 1e-14
"""Least mass of a vertex [kg]: MuJoCo takes masses up to 1e-15 for none."""

_STABILITY_LIMIT = {"RK4": 8.0**0.5}
"""Stability limit of omega h for RK4; it is 2 for the others."""

_SCRIPT_TEMPLATE = """\
import time
import mujoco
import numpy as np
known = np.load("{name}.npz")  # the same network as arrays, and where springbench's run of MuJoCo ended
model = mujoco.MjModel.from_xml_path("{name}.xml")
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)
{load}began = time.perf_counter()
{loop}seconds, p = time.perf_counter() - began, data.qpos.reshape(-1, 3)
print(f"{{seconds:.3g}} s; {{abs(p - known['end'][known['free']]).max():.3g}} m from the end of that run")
"""

_PLAIN_LOOP = "mujoco.mj_step(model, data, nstep={steps})\n"

_DRIVEN_LOOP = """\
for begin, end in zip(known["pins"], known["pins"][1:]):  # {frames} frames
    for k in range({substeps}):
        data.mocap_pos[:] = begin + k / {substeps} * (end - begin)
        mujoco.mj_step(model, data)
    data.qvel[:] *= {factor!r}  # drag
"""


@dataclass(frozen=True)
class MujocoEngine(ExternalEngine):
    """MuJoCo.

    Args:
        mujoco_integrator: one of MuJoCo's four integrators, by its MuJoCo name.
    """

    solver_name: ClassVar[str] = "mujoco"
    engine_package: ClassVar[EnginePackage] = EnginePackage("mujoco", "mujoco", "mujoco")
    supports_damping: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        ENGINE_FAMILY,
        Citation(
            "Todorov, Emanuel and Erez, Tom and Tassa, Yuval",
            2012,
            "MuJoCo: a physics engine for model-based control",
            "10.1109/IROS.2012.6386109",
        ),
        is_substepping=True,
        package_name="mujoco",
        formula="MuJoCo: spatial tendons between slide joints",
        cost="1 engine substep",
    )

    mujoco_integrator: MujocoIntegrator = "implicitfast"

    def build_stepper(self, network: EngineNetwork, library: Any) -> tuple[_MujocoStepper, str]:
        """Compile the network into a model of MuJoCo.

        Args:
            network: masses, springs, dashpots, drag and pins in the form that engines support.
            library: the imported module `mujoco`.

        Returns:
            The stepper, and a description with the integrator and its stability limit.

        Raises:
            Unsupported: for masses that MuJoCo treats as zero.
        """
        model = library.MjModel.from_xml_string(build_mjcf(network, self.mujoco_integrator))
        limit = _STABILITY_LIMIT.get(self.mujoco_integrator, 2.0)
        return _MujocoStepper(
            library, model, network
        ), f"{self.mujoco_integrator}, stable with springs while omega h < {limit:.2g}"

    def write_script(
        self, file_stem: str, network: EngineNetwork, problem: StepProblem, frames: ScriptFrames
    ) -> dict[str, str]:
        """Return scripts that repeat a motion from a step's start with the engine only.

        Args:
            file_stem: NAME of the files.
            network: the network, which becomes the model of `NAME.xml`.
            problem: the step whose start is the model's key frame, and whose load acts in all frames.
            frames: frames and their substeps.

        Returns:
            The texts of `NAME.py` and `NAME.xml`, by file name.

        Raises:
            Unsupported: for masses that MuJoCo treats as zero.
        """
        load = (
            ""
            if network.uniform_acceleration(problem.external_force) is not None
            else 'known["force"][known["free"]].ravel()'
        )
        load = f"data.qfrc_applied[:] = {load}\n" if load else ""
        text = _SCRIPT_TEMPLATE.format(name=file_stem, load=load, loop=frames.format_loop(_PLAIN_LOOP, _DRIVEN_LOOP))
        return {
            f"{file_stem}.py": text,
            f"{file_stem}.xml": build_mjcf(network, self.mujoco_integrator, problem, frames.num_substeps),
        }


class _MujocoStepper:
    """A compiled model with its state; free bodies come first, pinned bodies have prescribed poses ("mocap")."""

    def __init__(self, library: Any, model: Any, network: EngineNetwork) -> None:
        self._library, self._model, self._data, self._network = library, model, library.MjData(model), network
        library.set_mju_user_warning(_ignore_warning)  # otherwise MuJoCo writes a log file into the current folder

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in `substeps` substeps; return positions [m] and velocities [m/s] at its end."""
        net, model, data, start = self._network, self._model, self._data, problem.step_start
        gravity = net.uniform_acceleration(problem.external_force)
        model.opt.timestep = net.time_step / substeps
        model.opt.gravity[:] = 0.0 if gravity is None else gravity
        data.qfrc_applied[:] = problem.external_force[net.free_vertices].ravel() if gravity is None else 0.0
        data.qpos[:], data.qvel[:] = (
            start.positions[net.free_vertices].ravel(),
            start.velocity[net.free_vertices].ravel(),
        )
        begin, end = start.positions[net.pinned_vertices], problem.pin_targets
        places = interpolate_pins(begin, end, substeps)
        if places is None:
            data.mocap_pos[:] = begin
            self._library.mj_step(model, data, substeps)
        for place in places or ():
            data.mocap_pos[:] = place
            self._library.mj_step(model, data)
        p, v = start.positions.copy(), np.zeros_like(start.velocity)
        p[net.free_vertices], v[net.free_vertices] = data.qpos.reshape(-1, 3), data.qvel.reshape(-1, 3)
        p[net.pinned_vertices], v[net.pinned_vertices] = end, (end - begin) / net.time_step
        return p, v


def _ignore_warning(warning: str) -> None:
    """Ignore MuJoCo's warning: an unstable simulation is visible in the positions."""


def build_mjcf(network: EngineNetwork, integrator: str, problem: StepProblem | None = None, substeps: int = 1) -> str:
    """Build MuJoCo's XML of the network.

    Bodies are at the origin, so that joint coordinates equal positions exactly.

    Args:
        network: the network.
        integrator: MuJoCo's name of the integrator.
        problem: step problem whose start becomes the first key frame, None for no key frame.
        substeps: number of substeps per step.

    Raises:
        Unsupported: for masses that MuJoCo treats as zero.
    """
    net, lines = network, network.spring_dashpots
    if len(light := net.free_vertices[net.mass[net.free_vertices] < _MIN_MASS]):
        i = int(light[0])
        raise Unsupported(
            f"mujoco: vertex {i} has a mass of {net.mass[i]:.3g} kg, and at least {_MIN_MASS:g} kg are needed; give it "
            "more"
        )
    gravity = None if problem is None else net.uniform_acceleration(problem.external_force)
    option = f'timestep="{net.time_step / substeps!r}" integrator="{integrator}"'
    option += f' gravity="{_format_numbers(np.zeros(3) if gravity is None else gravity)}"'
    moving = "".join(
        f'<body><inertial pos="0 0 0" mass="{m!r}" diaginertia="1 1 1"/>'
        + "".join(f'<joint type="slide" axis="{axis}" damping="{c!r}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
        + f'<site name="{i}"/></body>\n'
        for i, m, c in zip(
            net.free_vertices.tolist(),
            net.mass[net.free_vertices].tolist(),
            net.vertex_drag[net.free_vertices].tolist(),
            strict=True,
        )
    )
    at = (
        np.zeros((len(net.pinned_vertices), 3))
        if problem is None
        else problem.step_start.positions[net.pinned_vertices]
    )
    weld_elements = "".join(
        f'<body mocap="true" pos="{_format_numbers(x)}"><site name="{i}"/></body>\n'
        for i, x in zip(net.pinned_vertices.tolist(), at, strict=True)
    )
    tendons = "".join(
        f'<spatial stiffness="{k!r}" springlength="{r!r}" damping="{c!r}">'
        f'<site site="{i}"/><site site="{j}"/></spatial>\n'
        for (i, j), k, r, c in zip(*(array.tolist() for array in lines), strict=True)
    )
    key = ""
    if problem is not None:
        p, v = problem.step_start.positions[net.free_vertices], problem.step_start.velocity[net.free_vertices]
        key = f'<keyframe><key qpos="{_format_numbers(p)}" qvel="{_format_numbers(v)}"/></keyframe>\n'
    return (
        f'<mujoco>\n<option {option}><flag autoreset="disable" constraint="disable" contact="disable"/></option>\n'
        f"<worldbody>\n{moving}{weld_elements}</worldbody>\n<tendon>\n{tendons}</tendon>\n{key}</mujoco>\n"
    )


def _format_numbers(values: NDArray[np.float64]) -> str:
    """Format numbers with all their digits."""
    return " ".join(map(repr, values.ravel().tolist()))
