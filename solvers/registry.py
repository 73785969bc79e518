"""The solvers by name. A new one is one file and one line here."""

from __future__ import annotations

from collections import ChainMap
from importlib import import_module
from typing import Any

from solvers.about import About

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
}

OPTIONAL = {"eigen": "solvers.methods.eigen:EigenLocalGlobal"}
"""Those that need what is not everywhere, and refuse with the reason where it is missing."""

EVERY = ChainMap(SOLVERS, OPTIONAL)
"""All that a config can name."""


def load(target: str) -> Any:
    """The object that "module:name" names; its module is imported now and no sooner."""
    module, _, name = target.partition(":")
    return getattr(import_module(module), name)


def minimises(solver: Any) -> bool:
    """Whether a solver's iterates tend to a minimum; one that does not say counts as one whose do, and is graded so."""
    return getattr(solver, "minimises", True)


def about(solver: Any, name: str) -> About:
    """What a solver of this name tells of itself; one that tells nothing is a family of its own."""
    return getattr(solver, "about", About(name))
