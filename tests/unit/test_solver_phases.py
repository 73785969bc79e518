"""The column `solver_phases`: its text, and that its times are compared nowhere."""

from __future__ import annotations

import re

import pyarrow as pa
import pytest
from springbench.harness.experiments.archive import study_publication
from springbench.harness.results.solver_phases import SECONDS_PATTERN, format_phases


def test_phases_have_iterations_times_and_shares_summed_over_the_stages():
    stages = [{"lbfgs": (4, 1.0, 2e-4)}, {"lbfgs": (2, 1.0, 1e-4), "newton": (1, 6.0, 1.5e-2)}]
    assert format_phases(stages) == "lbfgs 6 (0.3 ms, 25% of cost); newton 1 (15 ms, 75% of cost)"


def test_a_solver_of_one_method_has_no_phases():
    assert format_phases([{}, {}]) is None


@pytest.mark.parametrize("seconds", [0.0, 3.21e-9, 2e-4, 1.0, 4321.0])
def test_times_of_any_size_are_left_out(seconds: float):
    text = format_phases([{"predicted tensions": (6, 0.0, seconds), "escape": (1, 2.0, seconds)}])
    assert text is not None
    assert re.sub(SECONDS_PATTERN, "", text) == "predicted tensions 6 (0% of cost); escape 1 (100% of cost)"


def test_a_study_that_times_nothing_has_no_times_of_phases():
    column = ["lbfgs 4 (0.2 ms, 100% of cost)", None]
    untimed = study_publication._omit_phase_times(pa.table({"frame": [1, 2], "solver_phases": column}))
    assert untimed.to_pydict() == {"frame": [1, 2], "solver_phases": ["lbfgs 4 (100% of cost)", None]}
    other = pa.table({"frame": [1]})
    assert study_publication._omit_phase_times(other) is other
