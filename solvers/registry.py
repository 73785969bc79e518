"""The solvers by name.

A built-in solver has a line here. `springbench.solvers.plugins.plugin_discovery` finds third-party ones.
"""

from __future__ import annotations

from typing import Any

from springbench.solvers.iteration.solver_info import SolverInfo
from springbench.solvers.plugins.plugin_discovery import PluginTable, load_target

__all__ = [
    "OPTIONAL_SOLVERS",
    "SOLVERS",
    "SOLVER_TABLE",
    "find_solver_info",
    "find_solver_name",
    "is_engine",
    "is_minimiser",
    "load_target",
]

SOLVERS = {
    "dense": "springbench.solvers.methods.local_global.reference_local_global:DenseLocalGlobal",
    "sparse": "springbench.solvers.methods.local_global.reference_local_global:SparseLocalGlobal",
    "numba": "springbench.solvers.methods.local_global.compiled_local_global:CompiledLocalGlobal",
    "anderson": "springbench.solvers.methods.quasi_newton.anderson:Anderson",
    "chebyshev": "springbench.solvers.methods.quasi_newton.chebyshev:Chebyshev",
    "lbfgs": "springbench.solvers.methods.quasi_newton.lbfgs:Lbfgs",
    "newton": "springbench.solvers.methods.newton.newton_direct:NewtonSolver",
    "newton-cg": "springbench.solvers.methods.newton.newton_cg:NewtonCG",
    "hybrid": "springbench.solvers.methods.newton.hybrid_newton:HybridNewton",
    "xpbd": "springbench.solvers.methods.position_based.xpbd:Xpbd",
    "xpbd-small-steps": "springbench.solvers.methods.position_based.xpbd:XpbdSmallSteps",
    "vbd": "springbench.solvers.methods.vertex_block.vbd:VertexBlockDescent",
    "symplectic-euler": "springbench.solvers.methods.time_stepping.symplectic_euler:SymplecticEuler",
    "velocity-verlet": "springbench.solvers.methods.time_stepping.explicit_integrators:VelocityVerlet",
    "blanes-moan-4": "springbench.solvers.methods.time_stepping.explicit_integrators:BlanesMoan4",
    "blanes-moan-6": "springbench.solvers.methods.time_stepping.explicit_integrators:BlanesMoan6",
    "runge-kutta-4": "springbench.solvers.methods.time_stepping.explicit_integrators:RungeKutta4",
    "tsitouras-5": "springbench.solvers.methods.time_stepping.explicit_integrators:Tsitouras5",
    "dormand-prince-8": "springbench.solvers.methods.time_stepping.explicit_integrators:DormandPrince8",
    "baraff-witkin": "springbench.solvers.methods.time_stepping.baraff_witkin:BaraffWitkin",
    "ros2": "springbench.solvers.methods.time_stepping.rosenbrock:Ros2",
    "ros3p": "springbench.solvers.methods.time_stepping.rosenbrock:Ros3P",
    "rodas": "springbench.solvers.methods.time_stepping.rosenbrock:Rodas",
    "pncg": "springbench.solvers.methods.quasi_newton.nonlinear_cg:NonlinearCG",
    "admm": "springbench.solvers.methods.local_global.admm:Admm",
    "a-jacobi": "springbench.solvers.methods.local_global.aggregated_jacobi:AggregatedJacobi",
    "mgpbd": "springbench.solvers.methods.position_based.mgpbd:MultigridXpbd",
    "jgs2": "springbench.solvers.methods.vertex_block.jgs2:Jgs2",
    "avbd": "springbench.solvers.methods.vertex_block.avbd:AugmentedVertexBlockDescent",
    "vbd-ogc": "springbench.solvers.methods.vertex_block.vbd_offset_contact:OffsetContactDescent",
}

OPTIONAL_SOLVERS = {
    "eigen": "springbench.solvers.methods.local_global.eigen_local_global:EigenLocalGlobal",
    "cholmod": "springbench.solvers.methods.local_global.cholmod_local_global:CholmodLocalGlobal",
    "mujoco": "springbench.solvers.external.mujoco_engine:MujocoEngine",
    "pypbd": "springbench.solvers.external.pypbd_engine:PyPbdEngine",
    "taichi": "springbench.solvers.external.taichi_newton_engine:TaichiNewtonEngine",
    "newton-physics": "springbench.solvers.external.newton_physics_engine:NewtonPhysicsEngine",
}
"""Solvers with optional dependencies; they raise an error with the reason if one is missing."""

SOLVER_TABLE = PluginTable("springbench.solvers", SOLVERS, OPTIONAL_SOLVERS)
"""All solvers that a config can name."""


def is_minimiser(solver: Any) -> bool:
    """Return whether the iterates converge to a minimum.

    A solver without the attribute `is_minimiser` is scored as if they do.
    """
    return getattr(solver, "is_minimiser", True)


def is_engine(solver: Any) -> bool:
    """Return whether a solver or its class is an external engine.

    The iterations of an external engine are its substeps.
    """
    return hasattr(solver, "write_script")


def find_solver_name(solver: Any) -> str:
    """Return the registered name of a solver, or else the name of its class."""
    kind: type = solver if isinstance(solver, type) else solver.__class__
    named = {target: name for name, target in (SOLVERS | OPTIONAL_SOLVERS).items()}
    return named.get(f"{kind.__module__}:{kind.__qualname__}", kind.__name__)


def find_solver_info(solver: Any, name: str) -> SolverInfo:
    """Return the metadata of a solver, or default metadata that contain only a family name.

    Args:
        solver: the solver or its class.
        name: name of the family if the solver has no metadata.
    """
    return getattr(solver, "solver_info", SolverInfo(name))
