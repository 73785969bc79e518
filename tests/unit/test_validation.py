"""The validation: closed forms within what refinement explains, textile tests, the page and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.experiments.validation import fabric_tests, validation_study
from springbench.harness.experiments.validation.closed_forms import (
    ClosedForm,
    list_closed_forms,
    solve_elastic_catenary,
    solve_elastica,
)
from springbench.harness.experiments.validation.validation_scenes import build_sheet
from springbench.harness.report.validation_page import format_validation_page, write_validation_page
from springbench.harness.scenes.fabric_table import PUBLISHED_FABRICS
from springbench.solvers.registry import SOLVERS, load_target
from typer.testing import CliRunner

NEWTON = load_target(SOLVERS["newton"])()
FORMS = {case.name: case for case in list_closed_forms()}
QUICK, SLOW = ("hanging chain", "membrane under pressure"), ("free fall", "elastic catenary")
"""Cases of tests that take a second, or some; the others take longer."""


def mark_duration(name: str) -> pytest.MarkDecorator | tuple[()]:
    return () if name in QUICK else pytest.mark.slow if name in SLOW else pytest.mark.long


@pytest.mark.parametrize("name", [pytest.param(name, marks=mark_duration(name)) for name in FORMS])
def test_the_error_of_a_closed_form_is_that_of_its_discretisation(name: str):
    (row,) = validation_study.validate_solver(NEWTON, [name])
    assert row["verdict"] == validation_study.CONFIRMED, row
    if row["observed_order"] is not None and not row["model_error"]:
        assert row["observed_order"] == pytest.approx(row["order"], abs=0.15)


def test_the_dampings_of_dashpot_and_integrator_are_separated():
    case = FORMS["damped oscillator"]
    assert case.remark is not None
    assert case.remark(100, NEWTON) == "decay 1.194/s, of which the dashpot 0.996 and implicit Euler 0.1983; exact 1"


def test_an_error_that_refinement_does_not_explain_is_named():
    honest = ClosedForm("x", "x [m]", "cells", (1, 2, 4), 1.0, 1.0, lambda n, solver: 1.0 + 0.1 / n)
    cases = {
        1.0: validation_study.CONFIRMED,
        0.97: validation_study.UNEXPLAINED,  # it converges to a value that is 3 % too large
    }
    for exact, verdict in cases.items():
        assert validation_study.grade_closed_form(replace(honest, exact=exact), NEWTON)["verdict"] == verdict


@pytest.mark.parametrize(
    "values",
    [(-4.9, -1e6, -1e15), (1.1, 2.7e18, 1.8e9), (1.0, 1.0, 2.0), (1.3, 1.2, 1.1), (1.0, float("nan"), float("nan"))],
    ids=["diverges", "diverged", "jumps at the end", "moves steadily", "no number"],
)
def test_a_series_that_does_not_converge_explains_nothing(tmp_path: Path, values: tuple[float, ...]):
    found: dict[int, float] = dict(zip((1, 2, 4), values, strict=True))
    case = ClosedForm("x", "x [m]", "cells", (1, 2, 4), 1.0, 1.0, lambda level, solver: found[level])
    row = validation_study.grade_closed_form(case, NEWTON)
    assert row["verdict"] == validation_study.UNEXPLAINED
    assert "unexplained" in format_validation_page([row], "newton")
    assert all(path.is_file() for path in write_validation_page([row], "newton", tmp_path))


def test_reference_solutions_have_their_limits():
    # A stiff strip drops by w L^4/(8 B); a stiff cable has the inextensible catenary's sag: 5 (sqrt(1 + x^2) - 1)/x.
    assert solve_elastica(0.1, 0.01)[0] == pytest.approx(0.01 * 0.1**4 / 8, rel=1e-6)
    horizontal, sag = solve_elastic_catenary(1e15)
    tangent = 10 * 9.81 / 2 / horizontal
    assert 10.0 * np.arcsinh(tangent) / tangent == pytest.approx(8.0, rel=1e-9)
    assert sag == pytest.approx(5.0 * (np.hypot(1.0, tangent) - 1.0) / tangent, rel=1e-9)


def test_a_shadow_counts_folds_once():
    flat = build_sheet(np.linspace(0.0, 0.1, 3), np.linspace(0.0, 0.1, 3))
    assert fabric_tests.compute_shadow_area(flat.rest_positions, flat.triangles) == pytest.approx(0.01, rel=0.02)
    folded = flat.rest_positions.copy()
    folded[:, 0] = np.minimum(folded[:, 0], 0.1 - folded[:, 0])
    assert fabric_tests.compute_shadow_area(folded, flat.triangles) == pytest.approx(0.005, rel=0.03)
    a, b, c = (flat.rest_positions[flat.triangles[:, k]] for k in range(3))
    assert len(np.unique(np.sign(np.cross(b - a, c - a)[:, 1]))) == 1
    assert len(flat.springs) == 12 + 8


@pytest.mark.long
def test_the_cantilever_test_gives_the_bending_length_of_its_rigidity():
    """At 41.5 degrees half the overhang is (B/w)^(1/3) by Peirce's approximate formula (1930)."""
    fabric = PUBLISHED_FABRICS["royal-target"]
    band = fabric_tests.measure_bending_length(fabric, NEWTON)
    assert band.value == pytest.approx((fabric.rigidity / fabric.density / 9.81) ** (1 / 3), rel=0.05)


ROWS = [
    {
        "kind": "closed form", "name": "a", "quantity": "x [m]", "refined": "cells", "levels": [1, 2, 4], "order": 1.0,
        "exact": 1.0, "values": [1.1, 1.05, 1.025], "errors": [0.1, 0.05, 0.025], "model_error": 0.0,
        "discretisation_error": 0.025, "explained_error": 0.03, "observed_order": 1.0, "verdict": "confirmed",
        "remark": "",
    },
    {
        "kind": "closed form", "name": "b", "quantity": "x [m]", "refined": "cells", "levels": [1, 2, 4], "order": 1.0,
        "exact": 1.0, "verdict": "refused", "remark": "supports springs only",
    },
    {
        "kind": "textile test", "name": "fabric c", "source": "s", "use": "u", "verdict": "outside band: drape",
        "bending_length": {"value": 0.02, "low": 0.01, "high": 0.03}, "remark": "",
        "drape_coefficient": {"value": 70.0, "low": 20.0, "high": 60.0}, "positions": [[0, 0, 0]], "triangles": [],
    },
]  # fmt: skip


def test_the_page_states_what_is_outside_a_band_and_what_springs_cannot_do(tmp_path: Path):
    page = format_validation_page(ROWS, "newton")
    assert "| a | x [m] | 1 | 1.025 | 0.025 | 0.03 | 1.00 of 1 | confirmed |" in page
    assert "| b | x [m] | 1 | | | | | refused |" in page
    assert "* b: supports springs only" in page
    assert "| c | 20.0 | 10.0 to 30.0 | 70 | 20 to 60 | outside band: drape |" in page
    assert "What springs cannot do" in page
    paths = write_validation_page(ROWS, "newton", tmp_path)
    assert [path.name for path in paths] == ["validation.json", "validation.md", "closed-forms.png", "fabrics.png"]
    assert "![Textile tests in their bands](fabrics.png)" in page
    assert "fabrics.png" not in format_validation_page(ROWS[:2], "newton"), "nothing of it was simulated"
    assert all(path.stat().st_size > 500 for path in paths)
    assert "positions" not in json.loads(paths[0].read_text())["rows"][2]


def test_the_command_writes_a_page_and_fails_for_an_unexplained_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    arguments = ["validate", "--case", "hanging chain", "-o", str(tmp_path / "page")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "confirmed" in result.output
    assert (tmp_path / "page" / "validation.md").is_file()
    wrong = replace(FORMS["hanging chain"], exact=0.08)
    monkeypatch.setattr(validation_study, "list_closed_forms", lambda: [wrong])
    assert CliRunner().invoke(app, arguments).exit_code == 1
    for bad in (["--case", "hanging chian"], ["--solver", "newtn"], ["-o", __file__]):
        assert CliRunner().invoke(app, ["validate", "--case", "hanging chain", *bad]).exit_code == 2


@pytest.mark.slow
def test_a_solver_that_cannot_do_a_case_is_a_row():
    rows = validation_study.validate_solver(load_target(SOLVERS["xpbd"])(), ["free fall", "clamped cantilever"])
    assert [row["verdict"] for row in rows] == [validation_study.CONFIRMED, validation_study.REFUSED]
