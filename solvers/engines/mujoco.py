"""MuJoCo: vertices are bodies on three slide joints, springs and dashpots are spatial tendons.

    M a = f - sum of k (l - r) + c dl/dt along the tendons - drag v

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

from solvers.about import ENGINE, About, Reference
from solvers.engines.base import Engine, Network, Package, evenly
from solvers.problem import Positions, StepProblem, Unsupported

Integrator = Literal["implicitfast", "implicit", "Euler", "RK4"]

_LIMIT = {"RK4": 8.0**0.5}
"""Stability limit of omega h for RK4; it is 2 for the others."""

_SCRIPT = """\
import time
import mujoco
import numpy as np
known = np.load("{name}.npz")  # the same network as arrays, and where springbench's run of MuJoCo ended
model = mujoco.MjModel.from_xml_path("{name}.xml")
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)
{load}began = time.perf_counter()
mujoco.mj_step(model, data, nstep={steps})
seconds, p = time.perf_counter() - began, data.qpos.reshape(-1, 3)
print(f"{{seconds:.3g}} s; {{abs(p - known['end'][known['free']]).max():.3g}} m from the end of that run")
"""


@dataclass(frozen=True)
class Mujoco(Engine):
    """MuJoCo.

    Args:
        integrator: one of MuJoCo's four integrators, by its MuJoCo name.
    """

    name: ClassVar[str] = "mujoco"
    package: ClassVar[Package] = Package("mujoco", "mujoco", "mujoco")
    damps: ClassVar[bool] = True
    about: ClassVar[About] = About(
        ENGINE,
        Reference(
            "Todorov, Emanuel and Erez, Tom and Tassa, Yuval",
            2012,
            "MuJoCo: a physics engine for model-based control",
            "10.1109/IROS.2012.6386109",
        ),
        own_steps=True,
        package="mujoco",
    )

    integrator: Integrator = "implicitfast"

    def built(self, network: Network, library: Any) -> tuple[_Model, str]:
        """Build the network in the engine; return its stepper and a description."""
        model = library.MjModel.from_xml_string(mjcf(network, self.integrator))
        limit = _LIMIT.get(self.integrator, 2.0)
        return _Model(library, model, network), f"{self.integrator}, stable with springs while omega h < {limit:.2g}"

    def script(self, name: str, network: Network, problem: StepProblem, substeps: int, frames: int) -> dict[str, str]:
        """Return scripts that repeat a motion from a step's start with the engine only, by file name."""
        load = "" if network.acceleration(problem.force) is not None else 'known["force"][known["free"]].ravel()'
        load = f"data.qfrc_applied[:] = {load}\n" if load else ""
        text = _SCRIPT.format(name=name, load=load, steps=substeps * frames)
        return {f"{name}.py": text, f"{name}.xml": mjcf(network, self.integrator, problem, substeps)}


class _Model:
    """A compiled model with its state; free bodies come first, pinned bodies have prescribed poses ("mocap")."""

    def __init__(self, library: Any, model: Any, network: Network) -> None:
        self._library, self._model, self._data, self._network = library, model, library.MjData(model), network
        library.set_mju_user_warning(_unheard)  # it would write a file here

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in `substeps` substeps; return positions [m] and velocities [m/s] at its end."""
        net, model, data, start = self._network, self._model, self._data, problem.start
        gravity = net.acceleration(problem.force)
        model.opt.timestep = net.time_step / substeps
        model.opt.gravity[:] = 0.0 if gravity is None else gravity
        data.qfrc_applied[:] = problem.force[net.free].ravel() if gravity is None else 0.0
        data.qpos[:], data.qvel[:] = start.positions[net.free].ravel(), start.velocity[net.free].ravel()
        begin, end = start.positions[net.pinned], problem.pin_targets
        places = evenly(begin, end, substeps)
        if places is None:
            data.mocap_pos[:] = begin
            self._library.mj_step(model, data, substeps)
        for place in places or ():
            data.mocap_pos[:] = place
            self._library.mj_step(model, data)
        p, v = start.positions.copy(), np.zeros_like(start.velocity)
        p[net.free], v[net.free] = data.qpos.reshape(-1, 3), data.qvel.reshape(-1, 3)
        p[net.pinned], v[net.pinned] = end, (end - begin) / net.time_step
        return p, v


def _unheard(warning: str) -> None:
    """Ignore MuJoCo's warning: an unstable simulation is visible in the positions."""


def mjcf(network: Network, integrator: str, problem: StepProblem | None = None, substeps: int = 1) -> str:
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
    net, lines = network, network.lines
    if (net.mass[net.free] < 1e-14).any():
        raise Unsupported("mujoco: takes masses below 1e-15 kg for none; give the vertices more")
    gravity = None if problem is None else net.acceleration(problem.force)
    option = f'timestep="{net.time_step / substeps!r}" integrator="{integrator}"'
    option += f' gravity="{_numbers(np.zeros(3) if gravity is None else gravity)}"'
    moving = "".join(
        f'<body><inertial pos="0 0 0" mass="{m!r}" diaginertia="1 1 1"/>'
        + "".join(f'<joint type="slide" axis="{axis}" damping="{c!r}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
        + f'<site name="{i}"/></body>\n'
        for i, m, c in zip(net.free.tolist(), net.mass[net.free].tolist(), net.drag[net.free].tolist(), strict=True)
    )
    at = np.zeros((len(net.pinned), 3)) if problem is None else problem.start.positions[net.pinned]
    held = "".join(
        f'<body mocap="true" pos="{_numbers(x)}"><site name="{i}"/></body>\n'
        for i, x in zip(net.pinned.tolist(), at, strict=True)
    )
    tendons = "".join(
        f'<spatial stiffness="{k!r}" springlength="{r!r}" damping="{c!r}">'
        f'<site site="{i}"/><site site="{j}"/></spatial>\n'
        for (i, j), k, r, c in zip(*(array.tolist() for array in lines), strict=True)
    )
    key = ""
    if problem is not None:
        p, v = problem.start.positions[net.free], problem.start.velocity[net.free]
        key = f'<keyframe><key qpos="{_numbers(p)}" qvel="{_numbers(v)}"/></keyframe>\n'
    return (
        f'<mujoco>\n<option {option}><flag autoreset="disable" constraint="disable" contact="disable"/></option>\n'
        f"<worldbody>\n{moving}{held}</worldbody>\n<tendon>\n{tendons}</tendon>\n{key}</mujoco>\n"
    )


def _numbers(values: NDArray[np.float64]) -> str:
    """Format numbers with all their digits."""
    return " ".join(map(repr, values.ravel().tolist()))
