"""Third-party integrators with error control: those of SciPy and CVODE of SUNDIALS.

CVODE is available if it is installed. Radau, BDF and CVODE's BDF use the sparsity of the Jacobian; CVODE's Adams method
uses matrix-free GMRES.
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
from springbench.harness.errors import RunFailed
from springbench.harness.reference.equations_of_motion import OdeState
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.model.step_problem import StepStart, is_lagged

_MAX_CVODE_STEPS = 10**8
"""Largest number of steps of CVODE; in practice the time limit ends it first."""


class InitialValueProblem(NamedTuple):
    """Initial value problem y' = F(t, y), y = (positions, velocities).

    Attributes:
        vector_field: the function F.
        initial_state: y at time 0.
        scene: scene that the equations belong to.
        t_end: end time [s].
        rtol: relative tolerance of y.
        atol: absolute tolerance of y [m, m/s].
    """

    vector_field: Callable[[float, OdeState], OdeState]
    initial_state: OdeState
    scene: Scene
    t_end: float
    rtol: float
    atol: float


@dataclass(frozen=True, slots=True)
class ThirdPartyIntegrator:
    """Integrator of another library.

    Attributes:
        order: approximate order of its error.
        integrate_to_end: returns the state at t_end; raises RunFailed.
        uses_compiled_forces: whether the forces are compiled.
        module: module that it needs; empty if it is always installed.
        pip_extra: extra that installs the module.
    """

    order: int
    integrate_to_end: Callable[[InitialValueProblem], OdeState]
    uses_compiled_forces: bool = True
    module: str = ""
    pip_extra: str = ""

    @property
    def missing_reason(self) -> str:
        """How to install the module if it is missing; empty otherwise."""
        if not self.module or find_spec(self.module):
            return ""
        return f"is not installed; `pip install 'springbench[{self.pip_extra}]'` installs it"


def _build_scipy_integrator(method: str) -> Callable[[InitialValueProblem], OdeState]:
    def end(motion: InitialValueProblem) -> OdeState:
        solve: Any = solve_ivp  # its stubs leave the result untyped
        more: dict[str, Any] = (
            {"jac_sparsity": build_jacobian_sparsity(motion.scene)} if method in ("Radau", "BDF") else {}
        )
        more |= {"rtol": motion.rtol, "atol": motion.atol}
        solved = solve(motion.vector_field, (0.0, motion.t_end), motion.initial_state, method, **more)
        if not solved.success:
            raise RunFailed(str(solved.message))
        return solved.y[:, -1]

    return end


def _build_cvode_integrator(method: str) -> Callable[[InitialValueProblem], OdeState]:
    def end(motion: InitialValueProblem) -> OdeState:
        def rate(t: float, y: OdeState, out: OdeState) -> None:
            out[:] = motion.vector_field(t, y)

        linear: dict[str, Any] = {"linsolver": "gmres"}
        if method == "BDF":
            linear = {"linsolver": "sparse", "sparsity": build_jacobian_sparsity(motion.scene)}
        made: Any = import_module("sksundae.cvode").CVODE(
            rate, method=method, rtol=motion.rtol, atol=motion.atol, max_num_steps=_MAX_CVODE_STEPS, **linear
        )
        solved = made.solve(np.array([0.0, motion.t_end]), motion.initial_state)
        if not solved.success:
            raise RunFailed(str(solved.message))
        return solved.y[-1]

    return end


_SUNDIALS_REQUIREMENT: dict[str, Any] = {"module": "sksundae", "pip_extra": "sundials"}
THIRD_PARTY_INTEGRATORS = {
    "scipy-dop853": ThirdPartyIntegrator(8, _build_scipy_integrator("DOP853")),
    "scipy-dop853-numpy": ThirdPartyIntegrator(8, _build_scipy_integrator("DOP853"), uses_compiled_forces=False),
    "scipy-rk45": ThirdPartyIntegrator(5, _build_scipy_integrator("RK45")),
    "scipy-lsoda": ThirdPartyIntegrator(5, _build_scipy_integrator("LSODA")),
    "scipy-bdf": ThirdPartyIntegrator(3, _build_scipy_integrator("BDF")),
    "scipy-radau": ThirdPartyIntegrator(5, _build_scipy_integrator("Radau")),
    "cvode-adams": ThirdPartyIntegrator(5, _build_cvode_integrator("Adams"), **_SUNDIALS_REQUIREMENT),
    "cvode-bdf": ThirdPartyIntegrator(3, _build_cvode_integrator("BDF"), **_SUNDIALS_REQUIREMENT),
}
"""Third-party integrators by the names of their rows."""


def build_jacobian_sparsity(scene: Scene) -> csr_array:
    """Return the sparsity pattern of F's Jacobian, (6 f, 6 f) for f free vertices.

    An entry is 1 where the Jacobian may differ from zero.
    """
    system, p = scene.system, scene.mesh.rest_positions
    begun = StepStart(p, np.zeros_like(p), 0.0, p, system.velocity_rate, 0.0)
    n = 3 * system.num_vertices
    begins = (energy.begin_step(begun) if is_lagged(energy) else energy for energy in system.energies)
    all_of_them = sum((abs(energy.hessian(p)) for energy in begins), csr_array((n, n)))
    whole = kron(eye_array(system.num_vertices), np.ones((1, 3)))  # a vertex couples with all of its coordinates
    vertices = csr_array(csr_array(whole @ all_of_them @ whole.T)[system.free_vertices])[:, system.free_vertices]
    coupled = csr_array(kron(vertices + eye_array(len(system.free_vertices)), np.ones((3, 3))))
    coupled.data[:] = 1.0
    return csr_array(block_array([[None, eye_array(coupled.shape[0])], [coupled, coupled]]))
