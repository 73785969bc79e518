"""Implicit time stepping of mass-spring systems: scenes, solvers, sweeps, recordings, pictures.

`dir(springbench)` lists what scripts and notebooks use, and what authors of solvers, effects, meshes,
integrators and reports need. Names are imported on first use.

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
    from springbench.harness.report.charts.chart_description import (
        ChartAxis,
        ChartDescription,
        ChartFrame,
        ChartSeries,
        select_panels,
    )
    from springbench.harness.report.charts.figure_panels import (
        AxisScale,
        CellMap,
        CellOutcome,
        CurvePlot,
        CurveSeries,
        FigurePanel,
        MapCell,
        MarkedValue,
        MeshPicture,
        MeshRenderer,
        ShadedBand,
    )
    from springbench.harness.report.plot_style import (
        SeriesStyle,
        assign_solver_styles,
    )
    from springbench.harness.report.report_plugins import (
        ReportFunction,
    )
    from springbench.harness.report.robustness import (
        RunOutcome,
        VerifiedRun,
        read_verified_runs,
    )
    from springbench.harness.scenes.effects.effect_interface import (
        DerivedEnergies,
        EffectContribution,
        ForceFunction,
        ObservedMotion,
        PinGroup,
        SceneCheck,
        SceneEffect,
        VelocityFilter,
        build_constant_force,
    )
    from springbench.harness.scenes.mesh.mesh import (
        BEND,
        SHEAR,
        STRETCH,
        Mesh,
        SpringProperties,
    )
    from springbench.harness.scenes.mesh.mesh_generator import (
        LengthMetres,
        MeshGenerator,
    )
    from springbench.harness.scenes.mesh.mesh_topology import (
        assemble_mesh,
    )
    from springbench.harness.schema.base_model import (
        ConfigModel,
        Vector3,
    )
    from springbench.solvers.iteration.iterative_solver import (
        IterativeSolver,
        SolverState,
    )
    from springbench.solvers.iteration.solver_info import (
        Citation,
        SolverInfo,
    )
    from springbench.solvers.linalg.direct_solvers import (
        DenseCholesky,
        LinearSolver,
        SparseLU,
    )
    from springbench.solvers.methods.local_global.fixed_point import (
        FixedPointSolver,
    )
    from springbench.solvers.methods.local_global.prefactored import (
        PreparedLocalGlobal,
        prepare_local_global,
        require_projective,
    )
    from springbench.solvers.model.energies.spring_energy import (
        Springs,
    )
    from springbench.solvers.model.integrators import (
        AnyIntegrator,
        GeneralisedAlpha,
        RungeKutta,
        SingleStageIntegrator,
        find_integrator,
    )
    from springbench.solvers.model.integrators.integrator_stages import (
        Motion,
        Stage,
        StageGenerator,
        StageSolution,
        StepEnd,
    )
    from springbench.solvers.model.step_problem import (
        DirichletPins,
        Energy,
        LaggedEnergy,
        LengthConstraints,
        NotPositiveDefinite,
        Positions,
        PreparedSolver,
        ProjectiveEnergy,
        ResidualIterate,
        Solution,
        Solver,
        StepProblem,
        StepStart,
        StopRule,
        System,
        Unsupported,
    )
    from springbench.solvers.model.system_matrix_assembly import (
        assemble_system_matrix,
        mass_matrix_dense,
        mass_matrix_sparse,
        rest_lengths,
        selection_matrix_dense,
        selection_matrix_sparse,
        signed_incidence_matrix_dense,
        signed_incidence_matrix_sparse,
        system_matrix_dense,
        system_matrix_sparse,
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
    "springbench.harness.report.charts.chart_description": [
        "ChartAxis",
        "ChartDescription",
        "ChartFrame",
        "ChartSeries",
        "select_panels",
    ],
    "springbench.harness.report.charts.figure_panels": [
        "AxisScale",
        "CellMap",
        "CellOutcome",
        "CurvePlot",
        "CurveSeries",
        "FigurePanel",
        "MapCell",
        "MarkedValue",
        "MeshPicture",
        "MeshRenderer",
        "ShadedBand",
    ],
    "springbench.harness.report.plot_style": ["SeriesStyle", "assign_solver_styles"],
    "springbench.harness.report.report_plugins": ["ReportFunction"],
    "springbench.harness.report.robustness": ["RunOutcome", "VerifiedRun", "read_verified_runs"],
    "springbench.harness.scenes.effects.effect_interface": [
        "DerivedEnergies",
        "EffectContribution",
        "ForceFunction",
        "ObservedMotion",
        "PinGroup",
        "SceneCheck",
        "SceneEffect",
        "VelocityFilter",
        "build_constant_force",
    ],
    "springbench.harness.scenes.mesh.mesh": ["BEND", "SHEAR", "STRETCH", "Mesh", "SpringProperties"],
    "springbench.harness.scenes.mesh.mesh_generator": ["LengthMetres", "MeshGenerator"],
    "springbench.harness.scenes.mesh.mesh_topology": ["assemble_mesh"],
    "springbench.harness.schema.base_model": ["ConfigModel", "Vector3"],
    "springbench.solvers.iteration.iterative_solver": ["IterativeSolver", "SolverState"],
    "springbench.solvers.iteration.solver_info": ["Citation", "SolverInfo"],
    "springbench.solvers.linalg.direct_solvers": ["DenseCholesky", "LinearSolver", "SparseLU"],
    "springbench.solvers.methods.local_global.fixed_point": ["FixedPointSolver"],
    "springbench.solvers.methods.local_global.prefactored": [
        "PreparedLocalGlobal",
        "prepare_local_global",
        "require_projective",
    ],
    "springbench.solvers.model.energies.spring_energy": ["Springs"],
    "springbench.solvers.model.integrators": [
        "AnyIntegrator",
        "GeneralisedAlpha",
        "RungeKutta",
        "SingleStageIntegrator",
        "find_integrator",
    ],
    "springbench.solvers.model.integrators.integrator_stages": [
        "Motion",
        "Stage",
        "StageGenerator",
        "StageSolution",
        "StepEnd",
    ],
    "springbench.solvers.model.step_problem": [
        "DirichletPins",
        "Energy",
        "LaggedEnergy",
        "LengthConstraints",
        "NotPositiveDefinite",
        "Positions",
        "PreparedSolver",
        "ProjectiveEnergy",
        "ResidualIterate",
        "Solution",
        "Solver",
        "StepProblem",
        "StepStart",
        "StopRule",
        "System",
        "Unsupported",
    ],
    "springbench.solvers.model.system_matrix_assembly": [
        "assemble_system_matrix",
        "mass_matrix_dense",
        "mass_matrix_sparse",
        "rest_lengths",
        "selection_matrix_dense",
        "selection_matrix_sparse",
        "signed_incidence_matrix_dense",
        "signed_incidence_matrix_sparse",
        "system_matrix_dense",
        "system_matrix_sparse",
    ],
}
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names}
__all__ = [
    "BEND",
    "SHEAR",
    "STRETCH",
    "AnyIntegrator",
    "AxisScale",
    "CellMap",
    "CellOutcome",
    "ChartAxis",
    "ChartDescription",
    "ChartFrame",
    "ChartSeries",
    "Citation",
    "ConfigModel",
    "CurvePlot",
    "CurveSeries",
    "DenseCholesky",
    "DerivedEnergies",
    "DirichletPins",
    "EffectContribution",
    "Energy",
    "FigurePanel",
    "FixedPointSolver",
    "ForceFunction",
    "GeneralisedAlpha",
    "InputError",
    "InputMistake",
    "IntegratorName",
    "IterativeSolver",
    "LaggedEnergy",
    "LengthConstraints",
    "LengthMetres",
    "LinearSolver",
    "MapCell",
    "MarkedValue",
    "Mesh",
    "MeshGenerator",
    "MeshPicture",
    "MeshRenderer",
    "Motion",
    "NotPositiveDefinite",
    "ObservedMotion",
    "OptionKeys",
    "PinGroup",
    "PngImage",
    "Positions",
    "PreparedLocalGlobal",
    "PreparedSolver",
    "ProjectiveEnergy",
    "ReportFunction",
    "ResidualIterate",
    "RunFailed",
    "RunOutcome",
    "RunRecording",
    "RungeKutta",
    "SceneCheck",
    "SceneEffect",
    "SceneKeys",
    "SeriesStyle",
    "ShadedBand",
    "Simulation",
    "SingleStageIntegrator",
    "Solution",
    "Solver",
    "SolverInfo",
    "SolverName",
    "SolverState",
    "SparseLU",
    "SpringProperties",
    "SpringbenchError",
    "Springs",
    "Stage",
    "StageGenerator",
    "StageSolution",
    "StepEnd",
    "StepProblem",
    "StepStart",
    "StopRule",
    "SweepKeys",
    "System",
    "Unsupported",
    "UserCodeName",
    "Vector3",
    "VelocityFilter",
    "VerifiedRun",
    "assemble_mesh",
    "assemble_system_matrix",
    "assign_solver_styles",
    "build_constant_force",
    "draw_picture",
    "find_integrator",
    "load_rows",
    "load_scene",
    "make_scene",
    "mass_matrix_dense",
    "mass_matrix_sparse",
    "open_recording",
    "prepare_local_global",
    "read_verified_runs",
    "require_projective",
    "rest_lengths",
    "run_config",
    "select_panels",
    "selection_matrix_dense",
    "selection_matrix_sparse",
    "signed_incidence_matrix_dense",
    "signed_incidence_matrix_sparse",
    "system_matrix_dense",
    "system_matrix_sparse",
    "view_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'springbench' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
