"""Where methods come from, in words and as BibTeX."""

import json
from dataclasses import asdict

import pytest
from springbench.harness.report.citations import format_bibtex, format_citation
from springbench.harness.results.solver_metadata import read_solver_metadata
from springbench.solvers.iteration.solver_info import LIU_2013, Citation
from springbench.solvers.registry import SOLVERS, load_target


def build_bibtex_entry(reference: Citation) -> str:
    return json.dumps(asdict(reference))


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        (
            LIU_2013,
            "Liu, Bargteil, O'Brien and Kavan 2013, Fast simulation of mass-spring systems, doi:10.1145/",
        ),
        (Citation("Wang, Huamin", 2015, "A title"), "Wang 2015, A title"),
    ],
)
def test_a_reference_is_a_line_of_words(reference: Citation, words: str):
    assert format_citation(build_bibtex_entry(reference)).startswith(words)


def test_what_has_no_reference_has_no_words():
    assert (format_citation(None), format_citation(""), format_bibtex([None, ""])) == ("", "", "")


def test_each_work_has_one_entry_and_a_key_of_its_own():
    other = Citation("Liu, Tiantian", 2013, "Another of the year")
    found = format_bibtex(map(build_bibtex_entry, (LIU_2013, other, LIU_2013)))
    assert [line for line in found.splitlines() if line.startswith("@")] == ["@misc{liu2013a,", "@misc{liu2013b,"]
    assert "  author = {Liu, Tiantian and Bargteil, Adam W. and O'Brien, James F. and Kavan, Ladislav},\n" in found


@pytest.mark.parametrize("solver", SOLVERS)
def test_rows_carry_what_each_solver_states(solver: str):
    found, method = read_solver_metadata(solver), load_target(SOLVERS[solver])
    assert json.loads(found["citation"]) == asdict(method.solver_info.citation)
    assert (found["family"], found["is_minimiser"]) == (method.solver_info.family, method.is_minimiser)
    assert method.solver_info.citation.doi.startswith("10.")


def test_what_is_no_solver_states_nothing():
    assert read_solver_metadata("machine") == {}
