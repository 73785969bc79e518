"""Findings are short pages made from the published set; a page or a picture that differs from it fails here."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from springbench.harness.experiments.archive.study_publication import MAX_PUBLISHED_BYTES
from springbench.harness.report.pages.page_files import check_pages
from springbench.harness.results.published_set import PUBLISHED_FOLDER, list_studies

from tests.contracts.test_page_language import count_words, name_page

ROOT = Path(__file__).resolve().parents[2]
FINDINGS = sorted((ROOT / "results" / "findings").glob("*.md"))
PARTS = ("**Question.**", "| set-up | |", "![", "**Answer.**", "**Limits.**")

MAX_FINDINGS, MAX_FINDING_WORDS = 12, 600


def test_pages_and_pictures_are_those_of_the_published_set() -> None:
    assert check_pages(ROOT) == []


@pytest.mark.slow
def test_pictures_look_as_the_present_code_draws_them() -> None:
    assert check_pages(ROOT, draws_pictures=True) == []


def test_the_published_set_is_small() -> None:
    studies = list_studies(ROOT / PUBLISHED_FOLDER)
    assert all(study.config_path.is_file() for study in studies)
    files = [path for study in studies for path in study.folder.glob("*.parquet")]
    assert sum(path.stat().st_size for path in files) <= MAX_PUBLISHED_BYTES


def test_there_are_few_findings() -> None:
    assert len(FINDINGS) <= MAX_FINDINGS


@pytest.mark.parametrize("page", FINDINGS, ids=name_page)
def test_a_finding_has_question_set_up_figure_answer_and_limits(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert [part for part in PARTS if part not in text] == []
    assert len(re.findall(r"!\[", text)) == 1
    assert count_words(re.sub(r"\]\([^)]*\)|<!--.*?-->", "]", text)) <= MAX_FINDING_WORDS
