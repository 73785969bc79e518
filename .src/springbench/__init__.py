"""Implicit time stepping of mass-spring systems: scenes, solvers, sweeps, recordings, pictures.

`dir(springbench)` lists what scripts and notebooks use, and what authors of solvers, effects, meshes and reports need.
Names are imported on first use.

    import springbench

    scene = springbench.load_scene("configs/scenes/hanging-cloth.yaml")
    positions = springbench.Simulation(scene, "hybrid").step()  # (n, 3) [m]
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from springbench.harness.api import (
        IntegratorName,
        OptionKeys,
        PngImage,
        RunRecording,
        SceneKeys,
        Simulation,
        SolverName,
        SweepKeys,
        UserCodeName,
        draw_picture,
        load_rows,
        load_scene,
        make_scene,
        open_recording,
        run_config,
        view_recording,
    )
    from springbench.harness.errors import (
        InputError,
        InputMistake,
        RunFailed,
        SpringbenchError,
    )
    from springbench.harness.scenes.effects.effect_interface import (
        EffectContribution,
        ForceFunction,
        PinGroup,
        SceneEffect,
        VelocityFilter,
    )
    from springbench.harness.scenes.mesh.mesh import (
        Mesh,
    )
    from springbench.harness.scenes.mesh.mesh_generator import (
        MeshGenerator,
    )
    from springbench.harness.scenes.mesh.mesh_topology import (
        assemble_mesh,
    )
    from springbench.harness.schema.base_model import (
        ConfigModel,
    )
    from springbench.solvers.iteration.iterative_solver import (
        IterativeSolver,
        SolverState,
    )
    from springbench.solvers.iteration.solver_info import (
        Citation,
        SolverInfo,
    )
    from springbench.solvers.methods.local_global.fixed_point import (
        FixedPointSolver,
    )
    from springbench.solvers.model.step_problem import (
        Energy,
        NotPositiveDefinite,
        Positions,
        PreparedSolver,
        ProjectiveEnergy,
        Solution,
        Solver,
        StepProblem,
        StepStart,
        StopRule,
        System,
        Unsupported,
    )

# OpenMP reads its settings when it is loaded. Idle OpenMP threads must sleep instead of spinning; otherwise the threads
# of Numba and BLAS slow each other down several times in one process.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_EXPORTS = {
    "springbench.harness.api": [
        "IntegratorName",
        "OptionKeys",
        "PngImage",
        "RunRecording",
        "SceneKeys",
        "Simulation",
        "SolverName",
        "SweepKeys",
        "UserCodeName",
        "draw_picture",
        "load_rows",
        "load_scene",
        "make_scene",
        "open_recording",
        "run_config",
        "view_recording",
    ],
    "springbench.harness.errors": ["InputError", "InputMistake", "RunFailed", "SpringbenchError"],
    "springbench.harness.scenes.effects.effect_interface": [
        "EffectContribution",
        "ForceFunction",
        "PinGroup",
        "SceneEffect",
        "VelocityFilter",
    ],
    "springbench.harness.scenes.mesh.mesh": ["Mesh"],
    "springbench.harness.scenes.mesh.mesh_generator": ["MeshGenerator"],
    "springbench.harness.scenes.mesh.mesh_topology": ["assemble_mesh"],
    "springbench.harness.schema.base_model": ["ConfigModel"],
    "springbench.solvers.iteration.iterative_solver": ["IterativeSolver", "SolverState"],
    "springbench.solvers.iteration.solver_info": ["Citation", "SolverInfo"],
    "springbench.solvers.methods.local_global.fixed_point": ["FixedPointSolver"],
    "springbench.solvers.model.step_problem": [
        "Energy",
        "NotPositiveDefinite",
        "Positions",
        "PreparedSolver",
        "ProjectiveEnergy",
        "Solution",
        "Solver",
        "StepProblem",
        "StepStart",
        "StopRule",
        "System",
        "Unsupported",
    ],
}
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names}
__all__ = [
    "Citation",
    "ConfigModel",
    "EffectContribution",
    "Energy",
    "FixedPointSolver",
    "ForceFunction",
    "InputError",
    "InputMistake",
    "IntegratorName",
    "IterativeSolver",
    "Mesh",
    "MeshGenerator",
    "NotPositiveDefinite",
    "OptionKeys",
    "PinGroup",
    "PngImage",
    "Positions",
    "PreparedSolver",
    "ProjectiveEnergy",
    "RunFailed",
    "RunRecording",
    "SceneEffect",
    "SceneKeys",
    "Simulation",
    "Solution",
    "Solver",
    "SolverInfo",
    "SolverName",
    "SolverState",
    "SpringbenchError",
    "StepProblem",
    "StepStart",
    "StopRule",
    "SweepKeys",
    "System",
    "Unsupported",
    "UserCodeName",
    "VelocityFilter",
    "assemble_mesh",
    "draw_picture",
    "load_rows",
    "load_scene",
    "make_scene",
    "open_recording",
    "run_config",
    "view_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'springbench' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
