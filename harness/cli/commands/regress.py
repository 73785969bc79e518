"""The command `springbench regress`: performance regressions against a revision, from a table, or between stored
results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from springbench.harness.console import get_output_console, print_message
from springbench.harness.errors import InputError


def regress(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(help="With --against a scene or a sweep; else a table of gates, or two stored results."),
    ] = None,
    against: Annotated[str | None, typer.Option(help="A git revision to be no slower than.")] = None,
    pattern: Annotated[
        str, typer.Option("-k", help="With --against: the tree's own gates whose name holds this.")
    ] = "",
    budget: Annotated[float | None, typer.Option(help="Seconds that a gate may take; 240 if left out.")] = None,
    limit: Annotated[float | None, typer.Option(help="Ratio of times that counts as slower; 1.03 if left out.")] = None,
    clock: Annotated[str | None, typer.Option(help="cpu or wall; what suits the work if left out.")] = None,
    yardstick: Annotated[
        str | None, typer.Option(help="Between stored results: a solver whose multiples are compared instead of times.")
    ] = None,
    solver: Annotated[list[str] | None, typer.Option(help="For a scene: solvers; repeatable.")] = None,
    size: Annotated[list[int] | None, typer.Option(help="For a scene: mesh sizes; repeatable.")] = None,
    iterations: Annotated[int | None, typer.Option(help="For a scene: iteration limit of a step.")] = None,
    tolerance: Annotated[float | None, typer.Option(help="For a scene: relative tolerance of a step.")] = None,
) -> None:
    """Find performance regressions. Exit code 1: a regression; 3: inconclusive; 0: all tests pass."""
    files = paths or []
    chosen = {"--solver": solver, "--size": size, "--iterations": iterations, "--tolerance": tolerance}
    if against is not None:
        given = {"iterations": iterations, "tolerance": tolerance}
        stated = {name: value for name, value in given.items() if value is not None}
        options = _build_options(budget, limit, clock)
        raise typer.Exit(
            _compare_with_revision(
                against, files, pattern, options, {"solvers": solver or [], "sizes": size or [], **stated}
            )
        )
    if len(files) == 1 and files[0].suffix.lower() in (".yaml", ".yml"):
        for option, value in {**chosen, "--limit": limit, "--clock": clock, "-k": pattern}.items():
            if value:
                raise InputError(
                    f"{option}: a table of gates says so itself; change {files[0]}, or give --against REVISION"
                )
        raise typer.Exit(_run_table(files[0], _build_options(budget, limit, clock).budget))
    if pattern:
        raise InputError("-k: chooses gates to compare with another revision; wanted --against REVISION beside it")
    for option, value in {"--budget": budget, "--limit": limit, "--clock": clock, **chosen}.items():
        if value:
            raise InputError(f"{option}: nothing is timed between stored results; leave it out")
    if len(files) != 2:
        wanted = "wanted --against REVISION, a table of gates, or two stored results, the old one first"
        raise InputError(f"regress: came {len(files)} file{'s' * (len(files) != 1)}; {wanted}")
    raise typer.Exit(_compare_stored(files[0], files[1], yardstick))


def _compare_stored(old: Path, new: Path, yardstick: str | None) -> int:
    from springbench.harness.report import benchmark_comparison as benchmarks
    from springbench.harness.report import results_comparison

    ours = [path.suffix.lower() != ".json" for path in (old, new)]
    if ours[0] != ours[1]:
        raise InputError(f"{old} and {new} cannot be compared: one is of pytest-benchmark, the other is not")
    if all(ours):
        return results_comparison.compare_results(old, new, get_output_console(), yardstick)
    if yardstick:
        raise InputError("--yardstick: compares results of sweeps; a file of pytest-benchmark has its own ratios")
    return benchmarks.compare_benchmarks(old, new, get_output_console())


def _run_table(path: Path, budget: float) -> int:
    from springbench.harness.experiments.regression.regression_table import run_regression_table
    from springbench.harness.experiments.regression.revision_comparison import choose_exit_code

    return choose_exit_code([result.verdict for _, result in run_regression_table(path, budget, print_message)])


def _build_options(budget: float | None, limit: float | None, clock: str | None) -> Any:
    from springbench.harness.experiments.regression.abba_benchmark import TIME_BUDGET
    from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
    from springbench.harness.experiments.regression.revision_comparison import DEFAULT_MAX_RATIO, ComparisonOptions

    if clock not in (None, "cpu", "wall"):
        raise InputError(f"--clock: came {clock}; wanted cpu or wall")
    if budget is not None and not budget > 0:
        raise InputError(f"--budget: came {budget}; wanted seconds")
    try:
        SequentialTest(limit or DEFAULT_MAX_RATIO)
    except ValueError as error:
        raise InputError(f"--{error}") from error
    return ComparisonOptions(budget or TIME_BUDGET, limit or DEFAULT_MAX_RATIO, clock=clock)


def _compare_with_revision(
    revision: str, files: list[Path], pattern: str, options: Any, run_options: dict[str, Any]
) -> int:
    from springbench.harness.experiments.regression import git_worktrees
    from springbench.harness.experiments.regression.revision_comparison import (
        build_config_requests,
        build_test_requests,
        choose_exit_code,
        compare_revisions,
    )

    if len(files) > 1 or (files and pattern):
        raise InputError("regress --against: wanted one scene, one sweep, or -k NAME; came several of them")
    both = git_worktrees.open_revisions(git_worktrees.find_checkout(Path.cwd()), revision)
    requests = build_config_requests(both, files[0], run_options) if files else build_test_requests(both, pattern)
    found = compare_revisions(both, requests, options, print_message)
    return choose_exit_code([result.verdict for _, result in found])
