"""Third-party integrators with error control: those of SciPy and CVODE of SUNDIALS.

CVODE is available if it is installed.

Radau, BDF and CVODE's BDF use the sparsity of the Jacobian; CVODE's Adams method uses matrix-free GMRES.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.sparse import block_array, csr_array, eye_array, kron

from harness.base.errors import RunFailed
from harness.reference.motion import State
from harness.scenes.bind import Scene
from solvers.problem import Start, is_lagged

_STEPS = 10**8
"""Largest number of steps of CVODE; in practice the time limit ends it first."""


class InitialValueProblem(NamedTuple):
    """Initial value problem y' = F(t, y), y = (positions, velocities).

    Attributes:
        field: the function F.
        start: y at time 0.
        scene: scene that the equations belong to.
        until: end time [s].
        relative: relative tolerance of y.
        absolute: absolute tolerance of y [m, m/s].
    """

    field: Callable[[float, State], State]
    start: State
    scene: Scene
    until: float
    relative: float
    absolute: float


@dataclass(frozen=True, slots=True)
class Library:
    """Integrator of another library.

    Attributes:
        order: approximate order of its error.
        end: returns the state at until; raises RunFailed.
        compiled: whether the forces are compiled.
        module: module that it needs; empty if it is always installed.
        extra: extra that installs the module.
    """

    order: int
    end: Callable[[InitialValueProblem], State]
    compiled: bool = True
    module: str = ""
    extra: str = ""

    @property
    def missing(self) -> str:
        """How to install the module if it is missing; empty otherwise."""
        if not self.module or find_spec(self.module):
            return ""
        return f"is not installed; `.venv/bin/pip install -e '.[{self.extra}]'` in the checkout installs it"


def _scipy(method: str) -> Callable[[InitialValueProblem], State]:
    def end(motion: InitialValueProblem) -> State:
        solve: Any = solve_ivp  # its stubs say little of what it answers
        more: dict[str, Any] = {"jac_sparsity": pattern(motion.scene)} if method in ("Radau", "BDF") else {}
        more |= {"rtol": motion.relative, "atol": motion.absolute}
        solved = solve(motion.field, (0.0, motion.until), motion.start, method, **more)
        if not solved.success:
            raise RunFailed(str(solved.message))
        return solved.y[:, -1]

    return end


def _cvode(method: str) -> Callable[[InitialValueProblem], State]:
    def end(motion: InitialValueProblem) -> State:
        def rate(t: float, y: State, out: State) -> None:
            out[:] = motion.field(t, y)

        linear: dict[str, Any] = {"linsolver": "gmres"}
        if method == "BDF":
            linear = {"linsolver": "sparse", "sparsity": pattern(motion.scene)}
        made: Any = import_module("sksundae.cvode").CVODE(
            rate, method=method, rtol=motion.relative, atol=motion.absolute, max_num_steps=_STEPS, **linear
        )
        solved = made.solve(np.array([0.0, motion.until]), motion.start)
        if not solved.success:
            raise RunFailed(str(solved.message))
        return solved.y[-1]

    return end


_SUNDIALS: dict[str, Any] = {"module": "sksundae", "extra": "sundials"}
LIBRARIES = {
    "scipy-dop853": Library(8, _scipy("DOP853")),
    "scipy-dop853-numpy": Library(8, _scipy("DOP853"), compiled=False),
    "scipy-rk45": Library(5, _scipy("RK45")),
    "scipy-lsoda": Library(5, _scipy("LSODA")),
    "scipy-bdf": Library(3, _scipy("BDF")),
    "scipy-radau": Library(5, _scipy("Radau")),
    "cvode-adams": Library(5, _cvode("Adams"), **_SUNDIALS),
    "cvode-bdf": Library(3, _cvode("BDF"), **_SUNDIALS),
}
"""Third-party integrators by the names of their rows."""


def pattern(scene: Scene) -> csr_array:
    """Return the sparsity pattern of F's Jacobian, (6 f, 6 f).

    An entry is 1 where the Jacobian may differ from zero.
    """
    system, p = scene.system, scene.mesh.rest
    begun = Start(p, np.zeros_like(p), 0.0, p, system.rate, 0.0)
    n = 3 * system.vertices
    begins = (energy.begin_step(begun) if is_lagged(energy) else energy for energy in system.energies)
    all_of_them = sum((abs(energy.hessian(p)) for energy in begins), csr_array((n, n)))
    whole = kron(eye_array(system.vertices), np.ones((1, 3)))  # a vertex couples with all of its coordinates
    vertices = csr_array(csr_array(whole @ all_of_them @ whole.T)[system.free])[:, system.free]
    coupled = csr_array(kron(vertices + eye_array(len(system.free)), np.ones((3, 3))))
    coupled.data[:] = 1.0
    return csr_array(block_array([[None, eye_array(coupled.shape[0])], [coupled, coupled]]))
