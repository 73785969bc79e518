"""Repeat a published study on this machine (`springbench reproduce`).

All of its runs, or a random tenth of them, are executed in a separate folder, without recordings and pictures. The
tenth of an accuracy study is drawn from few step snapshots and motions. Their references take most of the time, and
only times on the same snapshot or motion have ratios. Steps of studies that publish no times are not timed. Runs that
are complete in the folder are not executed again.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from springbench.harness.config.accuracy_config import CurveSpec
from springbench.harness.config.accuracy_loader import load_accuracy
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import folder_locks, machine_info
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.accuracy_study import run_accuracy_study
from springbench.harness.experiments.completion_status import select_missing_units
from springbench.harness.experiments.experiment_units import choose_num_workers, execute_units
from springbench.harness.experiments.provenance import build_specification_columns
from springbench.harness.experiments.run_unit import RunUnit
from springbench.harness.experiments.sweep_plan import plan_runs
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.error_times import list_curve_times, list_simulation_times
from springbench.harness.report.robustness import classify_run
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.published_set import QUICK_SHARE, RUN_KEYS, PublishedStudy, open_study_folder
from springbench.harness.results.study_comparison import (
    AgreementLevel,
    RunAgreement,
    RunRows,
    compare_repeated_curve,
    compare_repeated_run,
    compare_time_ratios,
    group_curves,
    group_runs,
)
from springbench.harness.results.time_ratios import list_step_times
from springbench.solvers.registry import OPTIONAL_SOLVERS

RowPair = tuple[RunRows, RunRows]
"""Rows of a published run and of the repeated one."""


_UNPUBLISHED = "requests none of the published runs; publish the study again"


class StudyRepetition(NamedTuple):
    """Result of a repetition.

    Attributes:
        runs: agreement of each repeated run.
        ratios: agreement of the ratios of times; empty if the study publishes none.
    """

    runs: list[RunAgreement]
    ratios: list[RunAgreement]


def reproduce_study(
    study: PublishedStudy,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    *,
    seed: int | None = None,
    num_workers: int | None = None,
) -> StudyRepetition:
    """Repeat a study, or a tenth of it, and compare.

    Args:
        study: published study.
        folder: folder of the repeated results.
        display: shows progress.
        print_message: prints a remark.
        seed: seed that draws a tenth of the runs; None repeats all.
        num_workers: number of worker processes; chosen by cores and memory if left out.

    Returns:
        The agreement of the repeated runs, and of the ratios of times.

    Raises:
        InputError: the config of the study is missing, or requests none of its runs.
    """
    if study.find_table("rows"):
        return _reproduce_sweep(study, folder, display, print_message, seed, num_workers)
    if study.find_table("accuracy"):
        return _reproduce_accuracy(study, folder, display, print_message, seed)
    why = f"cannot be repeated run by run; its command does all of it: {study.metadata['command']}"
    raise InputError(InputMistake(why, study.folder))


def draw_sample(items: Sequence[Any], seed: int | None) -> list[Any]:
    """Draw a tenth of the items, at least one, in their order.

    Args:
        items: items to draw from.
        seed: seed of the selection; None selects all items.
    """
    if seed is None or not items:
        return list(items)
    count = max(1, math.ceil(QUICK_SHARE * len(items)))
    chosen = sorted(random.Random(seed).sample(range(len(items)), count))
    return [items[k] for k in chosen]


def draw_from_groups(items: Sequence[Any], get_group: Callable[[Any], Hashable], seed: int | None) -> list[Any]:
    """Draw a tenth of the items, at least one, from as few groups as suffice.

    Args:
        items: items to draw from, whose order remains.
        get_group: returns the group of an item.
        seed: seed of the selection; None selects all items.
    """
    if seed is None or not items:
        return list(items)
    chance = random.Random(seed)
    groups: dict[Hashable, list[int]] = {}
    for k, item in enumerate(items):
        groups.setdefault(get_group(item), []).append(k)
    count = math.ceil(QUICK_SHARE * len(items))
    chosen: list[int] = []
    for members in chance.sample(list(groups.values()), len(groups)):
        chosen += chance.sample(members, min(len(members), count - len(chosen)))
    return [items[k] for k in sorted(chosen)]


def classify_outcome(run: RunRows) -> str:
    """Classify a run in words: its outcome if it was verified, else its status."""
    rows = [dict(row) for row in run]
    if rows[0]["status"] == "ok" and all(
        row["stationarity"] is None and row["reference_distance"] is None for row in rows
    ):
        return "ok"
    return classify_run(rows)[0].label


def _reproduce_sweep(
    study: PublishedStudy,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    seed: int | None,
    num_workers: int | None,
) -> StudyRepetition:
    published_rows = read_study_rows(study)
    published = group_runs(published_rows)
    runs = _select_published_runs(load_config(study.config_path).list_runs(), published)
    if not runs:
        raise InputError(InputMistake(_UNPUBLISHED, study.config_path))
    chosen = dict(draw_sample(list(runs.items()), seed))
    timing = {} if study.is_timed else {"timing": "none"}
    specs = [run.replace_options(record=False, pictures=False, **timing) for run in chosen.values()]
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with folder_locks.lock_folder_exclusive(folder):
        planned = plan_runs(specs, folder)
        todo = select_missing_units(planned, "runs", print_message, rerun_stale=True)
        many = min(num_workers or choose_num_workers(), max(1, len(todo)))
        units = [RunUnit(p.run, p.files, None, 1 if study.is_timed else many) for p in todo]
        execute_units(units, display, num_workers=many)
    rows = parquet_rows.read_rows([p.files.rows_path for p in planned]).to_pylist()
    repeated: dict[str, list[Any]] = {run[0]["run_id"]: run for run in group_runs(rows).values()}
    machine = machine_info.describe_machine().machine_id
    pairs = [(published[key], repeated[spec.compute_run_id(machine)]) for key, spec in zip(chosen, specs, strict=True)]
    found = [
        compare_repeated_run(old, new, classify_outcome) for old, new in omit_missing_software(pairs, print_message)
    ]
    ratios = compare_time_ratios(list_step_times(published_rows), list_step_times(rows)) if study.is_timed else []
    return StudyRepetition(found, ratios)


def omit_missing_software(pairs: Sequence[RowPair], print_message: Callable[[str], None]) -> list[RowPair]:
    """Return the pairs of rows of solvers whose software is installed here.

    The software of an optional solver counts as missing if the solver supports none of the repeated runs here, but at
    least one of them as published.

    Args:
        pairs: published and repeated rows of each run.
        print_message: called for each missing solver with the number of its runs and the reason.
    """
    here = {new[0]["solver"] for _, new in pairs if new[0]["status"] != "unsupported"}
    found: list[RowPair] = []
    omitted: dict[str, list[str]] = {}
    there = {old[0]["solver"] for old, _ in pairs if old[0]["status"] != "unsupported"}
    missing = (there - here) & OPTIONAL_SOLVERS.keys()
    for old, new in pairs:
        if new[0]["solver"] in missing:
            omitted.setdefault(new[0]["solver"], []).append(new[0]["reason"] or "")
        else:
            found.append((old, new))
    for solver, reasons in sorted(omitted.items()):
        print_message(f"{len(reasons)} runs of {solver} are not compared: {reasons[0]}")
    return found


def read_study_rows(study: PublishedStudy) -> list[dict[str, Any]]:
    """Read the rows of a published sweep, with nulls in columns that are not published."""
    with open_study_folder(study) as folder:
        return parquet_rows.read_rows(row_store.list_units(folder / "rows")).to_pylist()


def _select_published_runs(
    runs: Sequence[RunSpec], published: dict[tuple[Any, ...], list[Any]]
) -> dict[tuple[Any, ...], RunSpec]:
    """Return the runs of a config that are published, by their key there."""
    found: dict[tuple[Any, ...], RunSpec] = {}
    for run in runs:
        columns = build_specification_columns(run)
        key = tuple(columns[name] for name in RUN_KEYS)
        for whole in ((*key, run.frames), (*key, 0)):
            if whole in published:
                found[whole] = run
                break
    return found


def _reproduce_accuracy(
    study: PublishedStudy,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    seed: int | None,
) -> StudyRepetition:
    """Repeat an accuracy study: convergence of curves, errors of simulations, and ratios of their times."""
    plan = load_accuracy(study.config_path)
    table = study.read_table("accuracy").to_pylist()
    units = {row[row_store.FILE_COLUMN] for row in table}
    curves, work = ([one for one in specs if one.build_file_stem() in units] for specs in (plan.curves, plan.work))
    if not curves and not work:
        raise InputError(InputMistake(_UNPUBLISHED, study.config_path))
    curves = draw_from_groups(curves, CurveSpec.build_problem_stem, seed)
    work = draw_from_groups(work, lambda spec: (spec.case.scene_name, spec.case.size, spec.t_end), seed)
    plan = replace(plan, curves=tuple(curves), work=tuple(work))
    files = run_accuracy_study(plan, folder, display, print_message, rerun_stale=True)
    rows = parquet_rows.read_rows(files, ACCURACY_SCHEMA).to_pylist()
    before, after = group_curves(table), group_curves(rows)
    pairs = [(before[key], curve) for key, curve in after.items() if key in before]
    found = [compare_repeated_curve(old, new) for old, new in omit_missing_software(pairs, print_message)]
    published = {_build_work_key(row): row for row in table if row["kind"] == "work"}
    repeated = {_build_work_key(row): row for row in rows if row["kind"] == "work"}
    pairs = [([published[key]], [row]) for key, row in repeated.items() if key in published]
    found += [_compare_work(old[0], new[0]) for old, new in omit_missing_software(pairs, print_message)]
    with open_study_folder(study) as published_folder:
        theirs = read_accuracy(published_folder)
    ours = read_accuracy(folder, files)
    ratios = compare_time_ratios(list_curve_times(theirs), list_curve_times(ours))
    ratios += compare_time_ratios(*list_simulation_times(theirs, ours))
    return StudyRepetition(found, ratios)


ERROR_TOLERANCE = 0.05
"""Relative difference of the error of a whole simulation: round-off changes where adaptive steps end."""


def _build_work_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return (*(row.get(name) for name in RUN_KEYS), row["t_end"])


def _compare_work(old: Mapping[str, Any], new: Mapping[str, Any]) -> RunAgreement:
    title = f"{old['scene']} {old['size']} {old['solver']} {old['integrator']} {old['time_step']:.3g} s"
    if old["status"] != new["status"]:
        why = f"published as {old['status']!r}, here {new['status']!r}"
        return RunAgreement(title, AgreementLevel.DIFFERENT, why)
    was, now = old["error"], new["error"]
    if was == now:
        return RunAgreement(title, AgreementLevel.IDENTICAL)
    if was is None or now is None or abs(now - was) > ERROR_TOLERANCE * was:
        return RunAgreement(title, AgreementLevel.DIFFERENT, f"error {was}, here {now}")
    return RunAgreement(title, AgreementLevel.CLOSE)
