"""Comparison of own runs with published ones: ratios to a reference solver, and iterations.

A row is a method of one's own results on a scene and size that a published study has too. Both ratios refer to the same
reference method, measured on the same machine as the method. Milliseconds of two machines are not compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.published_set import RUN_KEYS, PublishedStudy, open_study_folder
from springbench.harness.results.time_ratios import MethodTimeRatio, compute_time_ratios, list_step_times

_IterationMeans = dict[tuple[Any, ...], float]


class ComparedMethod(NamedTuple):
    """A method of one's own results next to the published one.

    Attributes:
        study: published study that has the scene and size.
        scene, size, solver: the run.
        reference: solver that the ratios refer to; empty if nothing was timed, or if the references differ.
        own_ratio, published_ratio: time over that of the reference; None if it is unknown.
        published_interval: interval in which a repetition should lie.
        own_iterations, published_iterations: mean per step; None if it is unknown.
    """

    study: str
    scene: str
    size: int
    solver: str
    reference: str
    own_ratio: float | None
    published_ratio: float | None
    published_interval: tuple[float, float] | None
    own_iterations: float | None
    published_iterations: float | None


def compare_with_published(results: Path, studies: Sequence[PublishedStudy]) -> list[ComparedMethod]:
    """Compare the rows of a folder of results with the published studies.

    Args:
        results: folder of one's own results, in which all folders of rows are read.
        studies: published studies; those without rows of runs are ignored.

    Raises:
        InputError: the folder has no rows, or none on a published scene and size.
    """
    folders = row_store.find_row_folders(results, "rows")
    own = [row for folder in folders for row in _read_rows(folder)]
    if not own:
        raise InputError(InputMistake("contains no rows of `springbench run`; run a sweep first", results))
    found = [line for study in studies if study.find_table("rows") for line in _compare_with_study(own, study)]
    if not found:
        there = ", ".join(study.study_name for study in studies if study.find_table("rows"))
        example = "`springbench run configs/quickstart.yaml`"
        why = f"contains no run on a scene and size of a published study ({there}); such as {example} has them"
        raise InputError(InputMistake(why, results))
    return found


def _read_rows(folder: Path) -> list[dict[str, Any]]:
    return parquet_rows.read_rows(row_store.list_units(folder)).to_pylist()


def _compare_with_study(own: Sequence[Mapping[str, Any]], study: PublishedStudy) -> list[ComparedMethod]:
    with open_study_folder(study) as folder:
        published = _read_rows(folder / "rows")
    places = {(row["scene"], row["size"]) for row in published}
    mine = [row for row in own if (row["scene"], row["size"]) in places and row["phase"] == "step"]
    ratios: dict[tuple[Any, ...], MethodTimeRatio] = {}
    if study.is_timed:
        ratios = {_build_key(one): one for one in compute_time_ratios(list_step_times(published))}
    timed = list_step_times(row for row in mine if row["timing"] != "none")
    own_ratios = {_build_key(one): one for one in compute_time_ratios(timed)}
    iterations, own_iterations = _average_iterations(published), _average_iterations(mine)
    lines: list[ComparedMethod] = []
    for key, count in own_iterations.items():
        here, there = own_ratios.get(key), ratios.get(key)
        if there and here and here.reference != there.reference:
            here = there = None
        reference = here.reference[0] if here else ""
        interval = there.accepted_interval if there else None
        scene, size, solver = key[:3]
        lines.append(
            ComparedMethod(
                study=study.study_name,
                scene=scene,
                size=size,
                solver=solver,
                reference=reference,
                own_ratio=here.ratio if here else None,
                published_ratio=there.ratio if there else None,
                published_interval=interval,
                own_iterations=count,
                published_iterations=iterations.get(key),
            )
        )
    return lines


def _build_key(one: MethodTimeRatio) -> tuple[Any, ...]:
    return *one.task, *one.method


def _average_iterations(rows: Iterable[Mapping[str, Any]]) -> _IterationMeans:
    """Compute the mean iterations of a step for each method."""
    counts: dict[tuple[Any, ...], list[int]] = {}
    for row in rows:
        if row["phase"] == "step" and row["num_iterations"] is not None:
            counts.setdefault(tuple(row[name] for name in RUN_KEYS), []).append(row["num_iterations"])
    return {key: mean(values) for key, values in counts.items()}


def build_comparison_table(lines: Sequence[ComparedMethod]) -> Table:
    """Build a printable table of the comparison."""
    table = Table(box=SIMPLE_HEAD, caption_justify="left")
    table.caption = "ratios of step times to the reference solver; in brackets the interval for other machines"
    for name in ("study", "scene", "solver", "over"):
        table.add_column(name)
    for name in ("yours", "published", "iterations", "published iterations"):
        table.add_column(name, justify="right")
    for one in lines:
        interval = one.published_interval
        bounds = f" [{interval[0]:.2g}, {interval[1]:.2g}]" if interval else ""
        table.add_row(
            *(one.study, f"{one.scene} {one.size or ''}".strip(), escape(one.solver), one.reference),
            *(_format_number(one.own_ratio), _format_number(one.published_ratio) + escape(bounds)),
            *(_format_number(one.own_iterations), _format_number(one.published_iterations)),
        )
    return table


def _format_number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
