"""Names and keys of configs written in Python: the types say what the models do, and pyright finds what they lack."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
import springbench
from springbench.harness.config.sweep_config import SHIPPED_REPORTS, SweepConfig, SweepOptions
from springbench.harness.config.typed_keys import (
    IntegratorName,
    OptionKeys,
    ReportName,
    SceneKeys,
    SolverName,
    SweepKeys,
)
from springbench.harness.errors import InputError
from springbench.harness.scenes.scene_spec import SceneFields
from springbench.solvers.model.integrators import INTEGRATORS
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS

ROOT = Path(__file__).resolve().parents[2]

MISTAKEN_CODE = """
import springbench

scene = springbench.make_scene(mesh={"kind": "grid"}, time_step=0.01, frames=3, mass=1.0)
fine = springbench.Simulation(scene, "newton", integrator="bdf2", rtol=None)
springbench.Simulation(scene, "hybird")  # 6
springbench.Simulation(scene, integrator="implicit-eular")  # 7
springbench.make_scene(mesh={"kind": "grid"}, time_step=0.01, frames=3, mass_per_aera=1.0)  # 8
sweep: springbench.SweepKeys = {"scenes": ["a.yaml"], "solvers": ["sparse"]}
springbench.run_config({"scenes": ["a.yaml"], "solvers": ["sparse"], "options": {"iteration": 3}}, name="a")  # 10
springbench.make_scene(mesh={"kind": "grid"}, time_step=0.01, frames="many")  # 11
springbench.run_config({"scenes": ["a.yaml"], "solvers": ["sprase"]}, name="a")  # 12
springbench.run_config({"scenes": ["a.yaml"], "solvers": ["sparse"], "reports": ["timings"]}, name="a")  # 13
"""


def test_types_name_what_is_shipped():
    assert set(get_args(SolverName)) == {*SOLVERS, *OPTIONAL_SOLVERS}
    assert set(get_args(IntegratorName)) == {*INTEGRATORS}
    assert set(get_args(ReportName)) == {*SHIPPED_REPORTS}


def test_types_have_the_keys_of_the_models():
    for keys, model in ((SceneKeys, SceneFields), (OptionKeys, SweepOptions), (SweepKeys, SweepConfig)):
        assert keys.__annotations__.keys() == model.model_fields.keys()


@pytest.mark.long
def test_a_type_checker_finds_names_and_keys_that_do_not_exist(tmp_path: Path):
    (tmp_path / "mistaken.py").write_text(MISTAKEN_CODE)
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT)], "typeCheckingMode": "strict"}))
    command = [
        Path(sys.executable).with_name("pyright"),
        "--outputjson",
        "--pythonpath",
        sys.executable,
        "-p",
        tmp_path,
    ]
    completed = json.loads(subprocess.run(command, capture_output=True, text=True, cwd=tmp_path).stdout)
    found = {problem["range"]["start"]["line"] + 1 for problem in completed["generalDiagnostics"]}
    assert found == {i for i, line in enumerate(MISTAKEN_CODE.splitlines(), 1) if "  # " in line}, completed


class UserSolver:
    """Arguments that a user might pass as a solver."""


def test_a_class_in_a_sweep_is_refused_with_the_name_to_use():
    message = r'solvers\[1\]: got the class UserSolver; expected .* "./test_api_types.py:UserSolver"'
    with pytest.raises(InputError, match=message):
        springbench.run_config({"scenes": ["a.yaml"], "solvers": ["sparse", UserSolver]}, name="a")  # type: ignore[list-item]
