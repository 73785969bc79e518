"""Command `springbench regress`: find performance regressions.

The subject selects what is compared: this checkout with a git revision, two solvers (a gates file), two stored results,
or the stored results of many commits.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from springbench.harness.console import get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError
from springbench.harness.results.regression_verdict import RegressionVerdict, combine_verdicts

if TYPE_CHECKING:
    from springbench.harness.experiments.regression.revision_comparison import ComparisonOptions

STORED_FOLDERS = (Path("results/bench"), Path(".benchmarks"))
"""Default folders of a history: that of this project, and that of pytest-benchmark."""

_SCENE_OPTIONS = ("--solver", "--size", "--max-iterations", "--rtol")
_TIMING_OPTIONS = ("--budget", "--max-ratio", "--clock")
_USED_OPTIONS = {
    "a comparison of a scene or a sweep with a revision": {*_TIMING_OPTIONS, *_SCENE_OPTIONS},
    "a comparison of gates with a revision": {*_TIMING_OPTIONS, "-k"},
    "a gates file, which sets the options of each gate": {"--budget"},
    "a comparison of stored results": {"--relative-to"},
    "--history": set[str](),
}
"""Kinds of comparison, and the options that each uses."""
SCENE, GATES, GATES_FILE, STORED, HISTORY = _USED_OPTIONS


def regress(
    subjects: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SUBJECT",
            help="A scene or a sweep, a gates file, or stored results; this checkout's gates if left out.",
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option(help="A git revision; or of stored results, a folder, an archive or pytest-benchmark's file."),
    ] = None,
    history: Annotated[
        bool, typer.Option("--history", help="Find changes over commits in files of pytest-benchmark, or folders.")
    ] = False,
    gate_name: Annotated[str, typer.Option("-k", help="Only the gates whose name contains this.")] = "",
    budget: Annotated[float | None, typer.Option(help="Seconds until a test is inconclusive; 240 if left out.")] = None,
    max_ratio: Annotated[
        float | None, typer.Option(help="Ratio of times that counts as slower; 1.03 if left out.")
    ] = None,
    clock: Annotated[
        Literal["cpu", "wall"] | None, typer.Option(help="If left out: cpu for one thread, wall for several.")
    ] = None,
    relative_to: Annotated[
        str | None, typer.Option(help="Of stored results: divide times by those of this solver.")
    ] = None,
    solver: Annotated[list[str] | None, typer.Option(help="For a scene: solvers; repeatable.")] = None,
    size: Annotated[list[int] | None, typer.Option(help="For a scene: mesh sizes; repeatable.")] = None,
    max_iterations: Annotated[int | None, typer.Option(help="For a scene: iteration limit of a step.")] = None,
    rtol: Annotated[float | None, typer.Option(help="For a scene: relative tolerance of the residual.")] = None,
) -> None:
    """Find performance regressions. Exit code 0: pass; 1: fail; 3: inconclusive."""
    paths = subjects or []
    kind = _choose_kind(paths, baseline, history=history)
    given = {"--budget": budget, "--max-ratio": max_ratio, "--clock": clock, "-k": gate_name}
    given |= {"--relative-to": relative_to, "--solver": solver, "--size": size}
    given |= {"--max-iterations": max_iterations, "--rtol": rtol}
    for option, value in given.items():
        if value not in (None, "", []) and option not in _USED_OPTIONS[kind]:
            raise InputError(f"{option}: does not apply to {kind}; leave it out")
    if kind == HISTORY:
        verdict = _find_history_changes(paths)
    elif kind == STORED:
        verdict = _compare_stored(Path(baseline or ""), paths[0], relative_to)
    elif kind == GATES_FILE:
        verdict = _run_gates_file(paths[0], _build_options(budget, None, None).budget)
    else:
        run_options = {"solvers": solver or [], "sizes": size or []}
        limits = {"max_iterations": max_iterations, "rtol": rtol}
        run_options |= {name: value for name, value in limits.items() if value is not None}
        options = _build_options(budget, max_ratio, clock)
        verdict = _compare_with_revision(baseline or "", paths, gate_name, options, run_options)
    raise typer.Exit(verdict.exit_code)


def _choose_kind(paths: Sequence[Path], baseline: str | None, *, history: bool) -> str:
    """Return the kind of comparison; raise InputError if subject and baseline do not fit."""
    if history:
        if baseline is not None:
            raise InputError("--history: compares all stored results; leave --baseline out")
        return HISTORY
    if len(paths) > 1:
        raise InputError(
            f"regress: got {len(paths)} subjects; expected one, and what it is compared with as --baseline"
        )
    is_yaml = bool(paths) and paths[0].suffix.lower() in (".yaml", ".yml")
    if baseline is None:
        if is_yaml:
            return GATES_FILE
        raise InputError(
            "regress: nothing to compare with; add --baseline REVISION (of a scene, a sweep or the gates of this "
            "checkout), --baseline RESULTS (of stored results) or --history"
        )
    if not paths:
        return GATES
    # A scene of the assignment is JSON, as are the files of pytest-benchmark.
    is_assignment = paths[0].suffix.lower() == ".json" and Path(baseline).suffix.lower() != ".json"
    return SCENE if is_yaml or (is_assignment and not Path(baseline).exists()) else STORED


def _build_options(budget: float | None, max_ratio: float | None, clock: str | None) -> ComparisonOptions:
    from springbench.harness.experiments.regression.abba_benchmark import TIME_BUDGET
    from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
    from springbench.harness.experiments.regression.revision_comparison import DEFAULT_MAX_RATIO, ComparisonOptions

    if budget is not None and not budget > 0:
        raise InputError(f"--budget: got {budget}; expected a positive number of seconds")
    max_ratio = DEFAULT_MAX_RATIO if max_ratio is None else max_ratio
    try:
        SequentialTest(max_ratio)
    except ValueError as error:
        raise InputError(f"--max-ratio: {str(error).partition(': ')[2]}") from error
    return ComparisonOptions(budget or TIME_BUDGET, max_ratio, clock=clock)


def _compare_with_revision(
    revision: str, paths: Sequence[Path], gate_name: str, options: ComparisonOptions, run_options: dict[str, Any]
) -> RegressionVerdict:
    from springbench.harness.experiments.regression import git_worktrees
    from springbench.harness.experiments.regression.revision_comparison import (
        build_config_requests,
        build_gate_requests,
        compare_revisions,
    )

    both = git_worktrees.open_revisions(git_worktrees.find_checkout(Path.cwd()), revision)
    requests = build_config_requests(both, paths[0], run_options) if paths else build_gate_requests(both, gate_name)
    found = compare_revisions(both, requests, options, print_message)
    return combine_verdicts(result.verdict for _, result in found)


def _run_gates_file(path: Path, budget: float) -> RegressionVerdict:
    from springbench.harness.experiments.regression.gates_file import run_gates_file

    return combine_verdicts(result.verdict for _, result in run_gates_file(path, budget, print_message))


def _compare_stored(baseline: Path, new: Path, relative_to: str | None) -> RegressionVerdict:
    from springbench.harness.report.benchmark_comparison import compare_benchmarks
    from springbench.harness.report.results_comparison import compare_results

    are_benchmarks = [path.suffix.lower() == ".json" for path in (baseline, new)]
    if are_benchmarks[0] != are_benchmarks[1]:
        raise InputError(f"{baseline} and {new} cannot be compared: one is a file of pytest-benchmark, one is not")
    if not all(are_benchmarks):
        return compare_results(baseline, new, get_output_console(), relative_to)
    if relative_to:
        raise InputError("--relative-to: applies to results of sweeps; a file of pytest-benchmark has its own ratios")
    return compare_benchmarks(baseline, new, get_output_console())


def _find_history_changes(paths: Sequence[Path]) -> RegressionVerdict:
    """Print the changes over commits.

    The changes do not affect the verdict, which is pass if there are enough results.
    """
    from springbench.harness.report.change_detection import (
        MIN_RESULTS,
        build_history_table,
        find_stored_files,
        read_histories,
    )

    places = paths or [folder for folder in STORED_FOLDERS if folder.exists()]
    files = find_stored_files(places)
    hint = "`pytest tests/bench --benchmark-only` stores one for the commit that is checked out"
    if not files:
        raise InputError(f"--history: no stored results in {', '.join(map(str, paths or STORED_FOLDERS))}; {hint}")
    found = read_histories(files)
    get_output_console().print(split_wide_table(build_history_table(found)))
    most = max((len(series.points) for series in found), default=0)
    if most < MIN_RESULTS:
        print_message(f"inconclusive: at most {most} results of a benchmark, expected {MIN_RESULTS}; {hint}")
        return RegressionVerdict.INCONCLUSIVE
    print_message(f"`springbench figure history {places[0]}` draws them")
    return RegressionVerdict.PASS
