"""Command `springbench recommend`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.cli.shared_options import SCENE_HELP, ResultsOption, describe_config
from springbench.harness.console import get_error_console, get_output_console, print_message, split_wide_table


def recommend(
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    error: Annotated[float, typer.Option(help="Target error, relative to the displacement from the start.")],
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    t_end: Annotated[
        float | None,
        typer.Option(
            help="Simulated time [s] at which the error is measured; 1 by default, or less if the motion cannot be "
            "predicted for so long."
        ),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Limit of a simulation's wall time [s].")] = 5.0,
    budget: Annotated[float, typer.Option(help="Limit of the wall time of all simulations [s].")] = 60.0,
    results: ResultsOption = Path("results"),
) -> None:
    """Find and check the cheapest integrator, time step, tolerance and solver for an error."""
    from rich.table import Table
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.accuracy.method_recommendation import recommend_method as find
    from springbench.harness.report.accuracy.recommendation_plot import CandidatePoint, draw_recommendation

    found = find(
        scene,
        error,
        size=size,
        t_end=t_end,
        time_limit=time_limit,
        budget=budget,
        results=results,
        display=create_display(get_error_console()),
        print_message=print_message,
    )
    integrated = found.checked_method.reference_kind == "integrated"
    table = Table(
        "", "error" if integrated else f"error ({found.checked_method.reference_kind})", "wall s per simulated s", "way"
    )
    for name, way in (("predicted", found.best_method), ("measured", found.checked_method)):
        table.add_row(name, f"{way.error:.3g}", f"{way.seconds_per_simulated_second:.4g}", str(way))
    get_output_console().print(split_wide_table(table))
    print_message(found.verdict)
    points = [
        CandidatePoint(way.work_spec.solver.name, way.error, way.seconds_per_simulated_second, str(way))
        for way in found.measured_methods
    ]
    title = (
        f"Ways to an error of {100 * error:g} %: {scene.stem} {found.best_method.work_spec.case.size or ''}".rstrip()
    )
    folder = results / f"recommend-{scene.stem}" / "pictures"
    t_end = found.best_method.work_spec.t_end
    name = f"ways-{scene.stem}-{found.best_method.work_spec.case.size}-{error:g}-{t_end:g}".replace(".", "_")
    facts = [f"{t_end:g} s simulated", "time stepping and solver together"]
    facts += [] if integrated else [f"by a {found.checked_method.reference_kind} reference"]
    picture, *_ = draw_recommendation(folder / name, title, facts, points, error)
    print_message(f"the runners-up are in {picture}")
    if command := found.best_method.format_command(scene):
        print_message(f"to run it:\n  {command}")
