"""The solvers by name. A new one is one file and one line here."""

from __future__ import annotations

from importlib import import_module
from typing import Any

SOLVERS = {
    "dense": "solvers.local_global:DenseLocalGlobal",
    "sparse": "solvers.local_global:SparseLocalGlobal",
    "numba": "solvers.compiled:CompiledLocalGlobal",
    "anderson": "solvers.anderson:Anderson",
    "chebyshev": "solvers.chebyshev:Chebyshev",
    "lbfgs": "solvers.lbfgs:Lbfgs",
    "newton": "solvers.newton:Newton",
    "newton-cg": "solvers.newton_cg:NewtonCG",
    "hybrid": "solvers.hybrid:Hybrid",
    "xpbd": "solvers.xpbd:Xpbd",
    "xpbd-small-steps": "solvers.xpbd:XpbdSmallSteps",
    "vbd": "solvers.vbd:VertexBlockDescent",
    "symplectic-euler": "solvers.symplectic_euler:SymplecticEuler",
}


def load(target: str) -> Any:
    """The object that "module:name" names; its module is imported now and no sooner."""
    module, _, name = target.partition(":")
    return getattr(import_module(module), name)
