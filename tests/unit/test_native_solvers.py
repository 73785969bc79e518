"""The programs in C++ as solvers: the iterates of the others, or a reason why there are none."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.harness.config.config_loader import load_config
from springbench.harness.results.solver_metadata import read_solver_metadata
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY
from springbench.solvers.methods.local_global import cpp_backend
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, StopRule, System, Unsupported
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, load_target

from tests.scene_builders import build_cloth, build_first_problem

NATIVE = ("eigen", "cholmod")

SCENE = """
mesh: {kind: chain, length: 2.0}
mass: 1.0
time_step: 1/30
frames: 2
default_size: 4
effects: [{kind: springs, stretch: 200}]
"""


def prepare_native(name: str, system: System) -> PreparedLocalGlobal:
    """The real one; where it cannot be compiled it refuses with the reason, and there is nothing to compare."""
    try:
        return load_target(OPTIONAL_SOLVERS[name])().prepare(system)
    except Unsupported as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", NATIVE)
@pytest.mark.parametrize("weight", [1e10, "exact"])
def test_iterates_are_those_of_the_other_backends(name: str, weight: float | str):
    scene = build_cloth(12, weight=weight)
    problem = build_first_problem(scene)
    ours = SparseLocalGlobal().prepare(scene.system)
    theirs = prepare_native(name, scene.system)
    for p, q in islice(zip(ours.iterates(problem), theirs.iterates(problem), strict=True), 30):
        # Two factorisations of a matrix with weights from 1e2 to 1e10: round-off in positions of a metre.
        np.testing.assert_allclose(q, p, rtol=0, atol=1e-11)
    stop = StopRule(1000, 1e-3)
    assert theirs.solve(problem, stop).num_iterations == ours.solve(problem, stop).num_iterations
    solution = theirs.solve(problem, StopRule(30))
    np.testing.assert_array_equal(solution.positions, next(islice(theirs.iterates(problem), 29, None)))
    assert solution.residual == pytest.approx(ours.solve(problem, StopRule(30)).residual, rel=1e-6)


@pytest.mark.parametrize("name", NATIVE)
def test_a_matrix_without_a_factor_is_refused(name: str):
    scene = build_cloth(3)
    prepare_native(name, scene.system)
    loose = System(np.full(9, -1.0), scene.system.time_step, scene.system.energies)
    with pytest.raises(NotPositiveDefinite):
        load_target(OPTIONAL_SOLVERS[name])().prepare(loose)


@pytest.mark.parametrize("name", NATIVE)
def test_other_energies_are_refused_before_anything_is_compiled(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cpp_backend, "load_library", lambda *_: pytest.fail("compiled"))
    system = build_cloth(3).system
    with pytest.raises(Unsupported, match=f"{name}: supports springs only"):
        load_target(OPTIONAL_SOLVERS[name])().prepare(
            System(system.mass, system.time_step, (*system.energies, _Other()))
        )


class _Other:
    def value(self, p: Positions) -> float:
        return 0.0

    def add_gradient(self, p: Positions, out: Positions) -> None:
        return None

    def hessian(self, p: Positions) -> csr_array:
        return csr_array((p.size, p.size))


@pytest.mark.parametrize("name", NATIVE)
def test_without_a_compiler_the_row_states_the_reason(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from springbench.harness.experiments.run_pipeline import execute_run
    from springbench.harness.experiments.sweep_plan import RunFiles

    monkeypatch.setattr(cpp_backend.shutil, "which", lambda _: None)
    (tmp_path / "chain.yaml").write_text(SCENE)
    (run,) = load_config(tmp_path / "chain.yaml", solvers=[name]).list_runs()
    (tmp_path / "rows").mkdir()
    (row,) = execute_run(run, RunFiles.for_run(run, tmp_path), lambda phase: None)
    assert (row["status"], row["family"]) == ("unsupported", LOCAL_GLOBAL_FAMILY)
    assert "there is no C++ compiler" in row["reason"]


def test_native_solvers_are_not_in_the_list_of_all_solvers():
    assert set(NATIVE) <= set(OPTIONAL_SOLVERS)
    assert not set(OPTIONAL_SOLVERS) & set(SOLVERS)
    assert all(read_solver_metadata(name)["is_minimiser"] for name in NATIVE)
