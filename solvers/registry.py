"""The solvers by name. A built-in solver has a line here; a third-party one needs none, see `solvers.plugins`."""

from __future__ import annotations

from typing import Any

from solvers.about import About
from solvers.plugins import Table, load

__all__ = ["EVERY", "OPTIONAL", "SOLVERS", "about", "load", "minimises", "name_of"]

SOLVERS = {
    "dense": "solvers.methods.local_global:DenseLocalGlobal",
    "sparse": "solvers.methods.local_global:SparseLocalGlobal",
    "numba": "solvers.methods.local_global_compiled:CompiledLocalGlobal",
    "anderson": "solvers.methods.anderson:Anderson",
    "chebyshev": "solvers.methods.chebyshev:Chebyshev",
    "lbfgs": "solvers.methods.lbfgs:Lbfgs",
    "newton": "solvers.methods.newton:Newton",
    "newton-cg": "solvers.methods.newton_cg:NewtonCG",
    "hybrid": "solvers.methods.hybrid:Hybrid",
    "xpbd": "solvers.methods.xpbd:Xpbd",
    "xpbd-small-steps": "solvers.methods.xpbd:XpbdSmallSteps",
    "vbd": "solvers.methods.vbd:VertexBlockDescent",
    "symplectic-euler": "solvers.methods.symplectic_euler:SymplecticEuler",
    "velocity-verlet": "solvers.methods.explicit:VelocityVerlet",
    "blanes-moan-4": "solvers.methods.explicit:BlanesMoan4",
    "blanes-moan-6": "solvers.methods.explicit:BlanesMoan6",
    "runge-kutta-4": "solvers.methods.explicit:RungeKutta4",
    "tsitouras-5": "solvers.methods.explicit:Tsitouras5",
    "dormand-prince-8": "solvers.methods.explicit:DormandPrince8",
    "baraff-witkin": "solvers.methods.linearised:BaraffWitkin",
    "ros2": "solvers.methods.rosenbrock:Ros2",
    "ros3p": "solvers.methods.rosenbrock:Ros3P",
    "rodas": "solvers.methods.rosenbrock:Rodas",
    "pncg": "solvers.methods.pncg:NonlinearCG",
    "admm": "solvers.methods.admm:Admm",
    "a-jacobi": "solvers.methods.a_jacobi:AggregatedJacobi",
    "mgpbd": "solvers.methods.mgpbd:MultigridXpbd",
    "jgs2": "solvers.methods.jgs2:Jgs2",
    "avbd": "solvers.methods.avbd:AugmentedVertexBlockDescent",
}

OPTIONAL = {
    "eigen": "solvers.methods.eigen:EigenLocalGlobal",
    "cholmod": "solvers.methods.cholmod:CholmodLocalGlobal",
    "mujoco": "solvers.engines.mujoco:Mujoco",
    "pypbd": "solvers.engines.pypbd:PyPbd",
    "taichi": "solvers.engines.taichi_newton:TaichiNewton",
    "newton-physics": "solvers.engines.newton_physics:NewtonPhysics",
}
"""Solvers with optional dependencies; they raise an error with the reason if one is missing."""

EVERY = Table("springbench.solvers", SOLVERS, OPTIONAL)
"""All solvers that a config can name."""


def minimises(solver: Any) -> bool:
    """Return whether the iterates converge to a minimum; a solver without `minimises` is scored as if they do."""
    return getattr(solver, "minimises", True)


def name_of(solver: Any) -> str:
    """Return the name of a solver: the registered one, or else the name of its class."""
    kind: type = solver if isinstance(solver, type) else solver.__class__
    named = {target: name for name, target in (SOLVERS | OPTIONAL).items()}
    return named.get(f"{kind.__module__}:{kind.__qualname__}", kind.__name__)


def about(solver: Any, name: str) -> About:
    """Return the metadata of a solver of this name.

    Without any, the solver is a family of its own.
    """
    return getattr(solver, "about", About(name))
