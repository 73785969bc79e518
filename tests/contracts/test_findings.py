"""Findings are short pages made from the published set; a page or a picture that differs from it fails here."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest
from springbench.harness.experiments.archive.study_publication import (
    MAX_PUBLISHED_BYTES,
    write_published_table,
    write_study_file,
)
from springbench.harness.report.pages.page_files import check_pages
from springbench.harness.results.published_set import PUBLISHED_FOLDER, list_studies, read_study

from tests.contracts.test_page_language import count_words, name_page

ROOT = Path(__file__).resolve().parents[2]
FINDINGS = sorted((ROOT / "results" / "findings").glob("*.md"))
PARTS = ("**Question.**", "| set-up | |", "![", "**Answer.**", "**Limits.**")

MAX_FINDINGS, MAX_FINDING_WORDS = 12, 600


@pytest.mark.slow
def test_pages_and_pictures_are_those_of_the_published_set_and_look_as_the_present_code_draws_them() -> None:
    assert check_pages(ROOT, draws_pictures=True) == []


def test_the_published_set_is_small() -> None:
    studies = list_studies(ROOT / PUBLISHED_FOLDER)
    assert all(study.config_path.is_file() for study in studies)
    files = [path for study in studies for path in study.folder.glob("*.parquet")]
    assert sum(path.stat().st_size for path in files) <= MAX_PUBLISHED_BYTES


def test_there_are_few_findings() -> None:
    assert len(FINDINGS) <= MAX_FINDINGS


@pytest.mark.parametrize("page", FINDINGS, ids=name_page)
def test_a_finding_has_question_set_up_figure_result_and_limits(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert [part for part in PARTS if part not in text] == []
    assert len(re.findall(r"!\[", text)) == 1
    assert count_words(re.sub(r"\]\([^)]*\)|<!--.*?-->", "]", text)) <= MAX_FINDING_WORDS


def test_a_changed_figure_in_the_data_makes_a_finding_and_its_picture_stale(tmp_path: Path) -> None:
    published, findings = tmp_path / PUBLISHED_FOLDER, tmp_path / "results" / "findings"
    for name in ("winners", "accuracy"):  # the page queries both
        shutil.copytree(ROOT / PUBLISHED_FOLDER / name, published / name)
    shutil.copy(ROOT / PUBLISHED_FOLDER / "pictures.json", published)
    (findings / "pictures").mkdir(parents=True)
    for name in ("winners.md.j2", "winners.md", "pictures/winners.png"):
        shutil.copy(ROOT / "results" / "findings" / name, findings / name)
    shutil.copytree(ROOT / "configs" / "winners", tmp_path / "configs" / "winners")
    shutil.copy(ROOT / "configs" / "winners.yaml", tmp_path / "configs")
    assert check_pages(tmp_path) == []
    study = read_study(published / "winners")
    table = study.read_table("accuracy")
    at = table.column_names.index("cpu_seconds")
    slower = pc.if_else(
        pc.equal(table["solver"], pa.scalar("velocity-verlet")),
        pc.multiply(table["cpu_seconds"], 10.0),
        table.column(at),
    )
    write_published_table(study.folder / "units.parquet", table.set_column(at, "cpu_seconds", slower))
    write_study_file(study.folder, study.metadata)
    assert [Path(line.split()[0]).name for line in check_pages(tmp_path)] == ["winners.md", "winners.png"]
