"""How many digits of positions a factor of Q leaves, who is warned, and what a failed run says of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.sweep_runner import describe_inaccurate_runs
from springbench.harness.reference.residual_audit import AuditedSolver
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.direct_solve_remarks import (
    describe_inaccurate_solvers,
    explain_residual,
    solves_with_system_matrix,
)
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.solve_accuracy import SolveAccuracy
from springbench.solvers.model.step_problem import DirichletPins, StopRule, System
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

CONFIGS = Path(__file__).parents[2] / "configs"
SOLVERS = ("dense", "sparse", "numba")


def scene_of(path: str) -> Scene:
    spec = load_scene(CONFIGS / path)
    return build_scene(spec, spec.default_size or 0, log_warnings=False)


def random_springs(seed: int) -> Springs:
    rng = np.random.default_rng(seed)
    edges = np.array([(i, j) for i in range(8) for j in range(i) if rng.random() < 0.5 or j == i - 1])
    return Springs(edges, 10.0 ** rng.uniform(-3, 6, len(edges)), np.ones(len(edges)), np.zeros((len(edges), 3)))


@pytest.mark.parametrize("weight", [None, 1e3, np.inf], ids=["no pin", "penalty pin", "exact pin"])
@pytest.mark.parametrize("seed", range(5))
def test_the_bound_is_above_the_condition_number(seed: int, weight: float | None):
    """That of Q scaled by its row sums, by its eigenvalues."""
    springs = random_springs(seed)
    pins = DirichletPins() if weight is None else DirichletPins(np.array([3]), np.array([weight]))
    system = System(np.full(8, 0.1), 0.5, (springs,), pins)
    free = system.free_vertices
    Q = assemble_system_matrix(system, [springs]).toarray()[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(Q.sum(axis=1))
    eigenvalues = np.linalg.eigvalsh(scale[:, None] * Q * scale)
    accuracy = SolveAccuracy.from_system(system, np.ones((8, 3)))
    assert accuracy is not None
    assert eigenvalues[0] == pytest.approx(1.0, rel=1e-6)
    assert eigenvalues[-1] <= accuracy.condition


def test_digits_decrease_with_stiffness_and_distance_and_increase_with_the_length_of_springs():
    """Two masses of 1 kg on a spring: cond <= 2 (1 + k dt^2)."""

    def digits(k: float, *, away: float = 1.0, length: float = 1.0, precision: str = "float64") -> float:
        springs = Springs(np.array([[0, 1]]), np.array([k]), np.array([length]), np.zeros((1, 3)))
        found = SolveAccuracy.from_system(System(np.ones(2), 1.0, (springs,)), np.full((2, 3), away), precision)
        assert found is not None
        return found.num_digits

    eps = np.finfo(np.float64).eps
    assert digits(1e6) == pytest.approx(-np.log10(2e6 * eps), abs=1e-5)
    assert digits(1e6, away=1e3, length=0.1) == pytest.approx(digits(1e6) - 4.0)
    assert digits(1e10) == pytest.approx(digits(1e6) - 4.0, abs=1e-5)
    assert digits(10.0, away=1e9, precision="float32") == pytest.approx(-np.log10(22 * np.finfo(np.float32).eps))
    assert digits(1e18) == 0.0


def test_vertices_without_mass_have_no_bound():
    springs = Springs(np.array([[0, 1]]), np.ones(1), np.ones(1), np.zeros((1, 3)))
    assert SolveAccuracy.from_system(System(np.array([1.0, 0.0]), 1.0, (springs,)), np.zeros((2, 3))) is None


@pytest.mark.parametrize("path", sorted((CONFIGS / "scenes").glob("*.yaml")), ids=lambda path: path.stem)
def test_no_shipped_scene_is_remarked_on(path: Path):
    assert describe_inaccurate_solvers(scene_of(f"scenes/{path.name}"), SOLVERS) == ""


@pytest.mark.parametrize(
    ("name", "solvers", "digits"),
    [
        ("effects-bending-1e12", "dense, sparse: ", "no digit is certain"),
        ("scales-components-1e12", "dense, sparse: ", "only about 2 digits are certain"),
        ("scales-cubes-1e6-m-apart", "dense, sparse, numba: ", "only about 3 digits are certain"),
        ("scales-cubes-1e9-m-apart", "dense, sparse: ", "no digit is certain"),
        ("scales-links-1e12", "dense, sparse: ", "only about 1 digit is certain"),
    ],
)
def test_solvers_with_few_digits_are_named_with_others_that_have_more(name: str, solvers: str, digits: str):
    """Below three digits `numba` solves for corrections, which are as accurate as the gradient."""
    said = describe_inaccurate_solvers(scene_of(f"hard/{name}.yaml"), SOLVERS)
    assert said.startswith(f"{solvers}entries of the system matrix have mixed scales")
    assert digits in said
    assert said.endswith("; take `newton` or `hybrid`")


@pytest.mark.parametrize("name", ["anderson", "newton", "hybrid", "vbd"])
def test_other_methods_are_not_remarked_on(name: str):
    assert not solves_with_system_matrix(name, {})


def test_runs_are_remarked_on_before_they_start(tmp_path: Path):
    """Once for each scene and time step: a shorter step has more inertia."""
    (tmp_path / "sweep.yaml").write_text(
        f"scenes: [{CONFIGS / 'hard' / 'scales-links-1e12.yaml'}, {CONFIGS / 'scenes' / 'chain.yaml'}]\n"
        "solvers: [sparse, dense, hybrid, {name: numba, precision: float32}]\n"
        "options: {time_step: [1/30, 1e-9], record: false}\n"
    )
    (said,) = describe_inaccurate_runs(load_config(tmp_path / "sweep.yaml").list_runs())
    assert said.startswith("scales-links-1e12: sparse, dense: entries of the system matrix")


def test_a_failed_run_names_the_cause_of_its_wrong_residual():
    scene = scene_of("hard/scales-links-1e12.yaml")
    audited = AuditedSolver(prepare(scene, SparseLocalGlobal()), SparseLocalGlobal(), {1})
    said = r"which is \S+: entries of the system matrix have mixed scales .* take `newton` or `hybrid`"
    with pytest.raises(RunFailed, match=said):
        list(simulate_scene(scene, audited, StopRule(300, 1e-6), initial_guess="previous", frames=1))


def test_rounding_errors_explain_no_larger_residuals_nor_those_of_other_methods():
    usual, mixed = (scene_of(path) for path in ("scenes/chain.yaml", "hard/scales-links-1e12.yaml"))
    for scene, solver, residual, is_explained in (
        (usual, SparseLocalGlobal(), 1e-6, False),
        (mixed, SparseLocalGlobal(), 1e-6, True),
        (mixed, SparseLocalGlobal(), 1e9, False),
        (mixed, NewtonSolver(), 1e-6, False),
        (mixed, CompiledLocalGlobal(), 1e-6, False),  # solves for corrections there
        (mixed, CompiledLocalGlobal(precision="float32"), 1e-6, True),
    ):
        said = explain_residual(solver, scene.system, scene.mesh.rest_positions, residual)
        assert bool(said) == is_explained, (solver, residual)
