"""Counts that pages state and code decides."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from springbench.harness.config.config_loader import load_config
from springbench.solvers.iteration.solver_info import ENGINE_FAMILY
from springbench.solvers.model.integrators import INTEGRATORS, SUBSTEPPING
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVER_TABLE, SOLVERS, find_solver_info, load_target

ROOT = Path(__file__).parents[2]
WORDS = {
    4: "four", 5: "five", 11: "eleven", 12: "twelve", 13: "thirteen", 24: "twenty-four", 25: "twenty-five",
    26: "twenty-six", 30: "thirty", 31: "thirty-one", 32: "thirty-two", 33: "thirty-three", 34: "thirty-four",
}  # fmt: skip
ENGINES = {
    name for name in OPTIONAL_SOLVERS if find_solver_info(load_target(SOLVER_TABLE[name]), name).family == ENGINE_FAMILY
}
OWN_SOLVERS = {*SOLVERS, *OPTIONAL_SOLVERS} - ENGINES


def read_page(page: str) -> str:
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


def test_the_first_page_counts_solvers_engines_and_integrators():
    integrators = len(set(INTEGRATORS) - {"substepping"})
    assert SUBSTEPPING is INTEGRATORS["substepping"]
    words = (
        f"any of {WORDS[len(OWN_SOLVERS)]} solvers, {WORDS[len(ENGINES)]} outside engines and {WORDS[integrators]} time"
    )
    assert words in read_page("README.md")


def test_the_page_of_configs_counts_the_solvers_of_the_hard_cases():
    runs = load_config(ROOT / "configs" / "hard.yaml", imports_code=False).list_runs()
    names = {run.solver.name for run in runs}
    words = (
        f"by {WORDS[len(names & OWN_SOLVERS)]} of the shipped solvers and {WORDS[len(names & ENGINES)]} outside engines"
    )
    assert words in read_page("configs/README.md")


@pytest.mark.long
@pytest.mark.skipif(Path(sys.prefix) != ROOT / ".venv", reason="another environment may hold anything")
def test_the_environment_with_dev_fits_in_the_size_that_the_first_page_states():
    (stated,) = re.findall(r"with `dev` ([0-9.]+) GB", (ROOT / "README.md").read_text())
    taken = sum(path.lstat().st_blocks * 512 for path in Path(sys.prefix).rglob("*"))
    assert taken / 2**30 <= float(stated)
