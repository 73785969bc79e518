"""Command `springbench recommend`."""

from __future__ import annotations

from contextlib import suppress
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from springbench.harness.cli.shared_options import SCENE_HELP, ResultsOption, describe_config
from springbench.harness.console import get_error_console, get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError, InputMistake

if TYPE_CHECKING:
    from springbench.harness.experiments.accuracy.recommendation_goal import MeasuredMethod


_UNITS = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


def recommend(
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    error: Annotated[
        float | None, typer.Option(help="Target error, relative to the displacement from the start.")
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="Wall time of a frame, which is a time step of the scene: 4ms, 250us or 0.1s.")
    ] = None,
    engine: Annotated[
        str | None, typer.Option(help="Only this solver or outside engine, such as mujoco; all by default.")
    ] = None,
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    t_end: Annotated[
        float | None,
        typer.Option(
            help="Simulated time [s] at which the error is measured; 1 by default, or less if the motion cannot be "
            "predicted for so long."
        ),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Limit of a simulation's wall time [s].")] = 5.0,
    search_time: Annotated[float, typer.Option(help="Limit of the wall time of all simulations [s].")] = 60.0,
    results: ResultsOption = Path("results"),
) -> None:
    """Recommend the cheapest method for an error, or the most accurate one for a budget.

    The budget is the wall time of a frame. The recommended method is checked by a repeated measurement.
    """
    from rich.table import Table
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.accuracy.method_recommendation import RecommendationOptions, recommend_method
    from springbench.harness.experiments.accuracy.recommendation_goal import RecommendationGoal
    from springbench.harness.report.charts.recommendation_chart import (
        CandidatePoint,
        RecommendationLimits,
        build_recommendation_chart,
    )
    from springbench.harness.report.figures.chart_sheets import draw_chart_sheets

    if (error is None) == (budget is None):
        raise InputError("recommend: give one of --error and --budget")
    goal = RecommendationGoal(error, None if budget is None else parse_duration(budget, "--budget"))
    options = RecommendationOptions(size, t_end, time_limit, engine, search_time)
    found = recommend_method(scene, goal, options, results, create_display(get_error_console()), print_message)
    integrated = found.checked_method.reference_kind == "integrated"
    rows: list[tuple[str, MeasuredMethod | None]] = [
        ("predicted", found.best_method),
        ("measured", found.checked_method),
    ]
    if budget is not None:
        rows += [("runner-up", found.find_runner_up())]
        rows += [("half the time", found.select_best(0.5)), ("twice the time", found.select_best(2.0))]
    heading = "error" if integrated else f"error ({found.checked_method.reference_kind})"
    table = Table("", heading, "wall s per simulated s" if budget is None else "ms a frame", "method")
    for name, method in rows:
        if method is None:
            table.add_row(name, "–", "–", "nothing that was measured")
            continue
        cost = method.seconds_per_simulated_second
        seconds = f"{cost:.4g}" if budget is None else f"{1e3 * found.frame * cost:.3g}"
        table.add_row(name, f"{method.error:.3g}", seconds, str(method))
    get_output_console().print(split_wide_table(table))
    print_message(found.verdict)
    points = [
        CandidatePoint(method.work_spec.solver.name, method.error, method.seconds_per_simulated_second, str(method))
        for method in found.measured_methods
    ]
    aim = f"Methods for an error of {100 * error:g} %" if error else f"Methods for {budget} a frame"
    title = f"{aim}: {scene.stem} {found.best_method.work_spec.case.size or ''}".rstrip()
    folder = results / f"recommend-{scene.stem}" / "pictures"
    t_end = found.best_method.work_spec.t_end
    requested = f"{error:g}" if error else f"{budget}"
    name = f"methods-{scene.stem}-{found.best_method.work_spec.case.size}-{requested}-{t_end:g}".replace(".", "_")
    facts = [f"{t_end:g} s simulated", "time stepping and solver together"]
    facts += [] if integrated else [f"by a {found.checked_method.reference_kind} reference"]
    chart = build_recommendation_chart(title, facts, points, RecommendationLimits(error, found.cost_limit))
    picture, *_ = draw_chart_sheets(chart, folder / name)
    print_message(f"the runners-up are in {picture}")
    if command := found.best_method.format_command(scene):
        print_message(f"to run it:\n  {command}")


def parse_duration(text: str, option: str) -> float:
    """Return the seconds of a duration with a unit, such as 4ms.

    Args:
        text: number and unit: us, ms or s.
        option: the option whose value it is, for the message.

    Raises:
        InputError: it is no number above 0 with such a unit.
    """
    number = text.strip().rstrip("mus")
    unit = text.strip()[len(number) :]
    with suppress(ValueError):
        if unit in _UNITS and 0.0 < float(number) < inf:
            return float(number) * _UNITS[unit]
    raise InputError(
        InputMistake(f"got {text!r}; expected a number above 0 with its unit: 4ms, 250us or 0.1s", key=option)
    )
