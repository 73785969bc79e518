"""Where is it? Questions of a reader from the field, each answered by the names of folders and files alone.

An answer is at most two choices away from the listing of a package: a folder, then a file. The file defines the
function or class that does it.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

LOCATIONS = {
    "where is the time of impact computed?": "solvers/contact/ccd.py:pair_collision_free_step_size",
    "which file adds friction's Hessian?": "solvers/contact/potentials/friction.py:write_friction_hessian",
    "where does a row get its residual?": "harness/simulation/instrumentation_pass.py:compute_returned_residual",
    "where is the numeric phase of Cholesky?": ("solvers/linalg/cholesky/block_multifrontal.py:run_stages"),
    "what do I change to add a stop criterion?": "solvers/model/step_problem.py:StopRule",
    "where is the barrier function?": "solvers/contact/potentials/barrier.py:barrier_derivatives",
    "where are candidate pairs found?": "solvers/contact/broad_phase/bvh.py:find_candidate_pairs",
    "where is the local step of local-global?": "solvers/kernels/spring_local_step.py:run_local_step",
    "where is the global step solved?": "solvers/methods/local_global/prefactored.py:PreparedLocalGlobal",
    "where is a spring's Hessian?": "solvers/kernels/spring_hessian.py:assemble_hessian",
    "where is the Armijo condition?": "solvers/kernels/line_search_conditions.py:is_armijo_step",
    "how does vertex block descent sweep?": "solvers/methods/vertex_block/vbd_sweeps.py:_sweep_vertices",
    "where are Runge-Kutta coefficients?": "solvers/model/integrators/implicit_runge_kutta.py:RungeKutta",
    "which column has which unit?": "harness/results/run_schema.py:ColumnSpec",
    "where is a step timed?": "harness/simulation/timing_pass.py:measure_run",
    "where is a minimum certified?": "harness/reference/certified_minimum.py:certify_minimum",
    "where is the YAML of a scene read?": "harness/config/config_loader.py:load_scene",
}


def find_definitions(path: Path) -> list[str]:
    """Return the names of all functions and classes of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)]


@pytest.mark.parametrize("question", LOCATIONS)
def test_a_question_leads_to_a_folder_and_a_file(question: str) -> None:
    path, _, definition = LOCATIONS[question].partition(":")
    assert path.count("/") <= 3, "a file of a package, or of a folder that a listing of two levels shows"
    assert definition in find_definitions(ROOT / path)
