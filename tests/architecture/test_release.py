"""Versions, changelog and workflows agree with the project."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read(path: Path) -> Any:
    return YAML(typ="safe", pure=True).load(path)


def commands(workflow: Any) -> list[str]:
    return [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]


def test_the_citation_has_the_version_of_the_package():
    assert read(ROOT / "CITATION.cff")["version"] == PROJECT["version"]


def test_the_changelog_begins_with_what_is_unreleased_and_has_this_version():
    sections = re.findall(r"^## (.+)$", (ROOT / ".github" / "CHANGELOG.md").read_text(), re.M)
    assert sections[0] == "Unreleased"
    assert PROJECT["version"] in sections


def test_one_workflow_does_what_developers_do():
    assert "bash .ci/run" in commands(read(ROOT / ".github" / "workflows" / "ci.yml"))


def test_the_wheel_is_checked_and_used_on_three_platforms_by_every_python():
    workflow = read(ROOT / ".github" / "workflows" / "wheels.yml")
    assert "python -m twine check --strict dist/*" in commands(workflow)
    matrix = workflow["jobs"]["use"]["strategy"]["matrix"]
    assert [name.partition("-")[0] for name in matrix["os"]] == ["ubuntu", "macos", "windows"]
    pythons = {*matrix["python"], *(entry["python"] for entry in matrix["include"])}
    assert pythons == {"3.11", "3.12", "3.13", "3.14"}
    next_minor = int(max(pythons).partition(".")[2]) + 1
    assert PROJECT["requires-python"] == f">={min(pythons)},<3.{next_minor}"
    named = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if line.startswith("Programming Language")]
    assert named == sorted(pythons)


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_no_workflow_reads_a_secret(path: Path):
    assert "secrets." not in path.read_text()
