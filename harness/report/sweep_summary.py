"""Summary at the end of a sweep: findings in sentences, and suggested commands."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from glob import escape
from pathlib import Path
from textwrap import wrap

from springbench.harness.config.shipped_configs import get_config_name
from springbench.harness.report import equal_accuracy
from springbench.harness.report.energy_losses import NOTABLE_SHARE, describe_losses, format_energy_share
from springbench.harness.report.equal_accuracy import compare_runs
from springbench.harness.report.timing_table import TABLE_WIDTH, RunTimes, label_runs

SOLVED_RESIDUAL = 1e-2
"""Share of a step's initial residual above which the final residual of a method that does not minimise is reported."""

STRAIN_GROWTH_FACTOR = 1.5
"""Growth factor of the largest strain above which it is reported.

If the growth also exceeds that of the 99th percentile by this factor, it is attributed to a point load.
"""


MAX_DISSIPATION_SENTENCES = 3
"""Maximum number of sentences on dissipation."""


def build_closing_lines(timed_runs: Sequence[RunTimes], config: Path, results: Path, folder: Path) -> list[str]:
    """Build the last lines of a sweep: findings, commands, and the page's address.

    No line is longer than TABLE_WIDTH, except for paths.

    Args:
        timed_runs: runs of the sweep.
        config: config that was run.
        results: folder of the results of all sweeps.
        folder: folder of this sweep's results.
    """
    page = results / "index.html"
    sentences = summarise_sweep(timed_runs)
    lines = ["what was learned:", *(f"  {line}" for line in sentences)] if sentences else []
    lines += ["what to do next:", *suggest_commands(timed_runs, config, results, folder / "recordings")]
    return [*lines, f"everything on one page: {page.resolve().as_uri()}"] if page.is_file() else lines


def summarise_sweep(timed_runs: Sequence[RunTimes]) -> list[str]:
    """Summarise speed, termination reasons, strains and dissipation of runs, in lines."""
    fine, names = [run for run in timed_runs if run.status == "ok"], label_runs(timed_runs)
    sentences = [
        *_describe_fastest(fine, names),
        *_describe_iteration_limits(fine),
        *_describe_unsolved(fine, names),
        *_describe_strain_growth(fine, names),
        *_describe_dissipation(fine, names),
    ]
    return [line for sentence in sentences for line in wrap(sentence, TABLE_WIDTH - 2, subsequent_indent="  ")]


def suggest_commands(timed_runs: Sequence[RunTimes], config: Path, results: Path, recordings: Path) -> list[str]:
    """Suggest commands, each with a comment.

    They replay a run, find the fastest solver at equal accuracy, and update the page.

    Args:
        timed_runs: runs of the sweep.
        config: config that was run.
        results: folder of the results of all sweeps.
        recordings: folder of this sweep's recordings.
    """
    suggestions: list[tuple[str, Path | str, str]] = []
    if best := _choose_recording(timed_runs, recordings):
        suggestions.append(("springbench view", best, "replay a run of the largest mesh"))
    scenes = {run.scene: None for run in timed_runs}
    if scene := next(filter(None, (_find_scene_file(config, name) for name in scenes)), None):
        suggestions.append(
            ("springbench recommend --error 1e-2", get_config_name(scene), "the cheapest method for an error of 1 %")
        )
    suggestions.append(("springbench report", results, "bring the page up to date, with recordings that it replays"))
    return [line for words, path, why in suggestions for line in (f"  # {why}", f"  {words} {shlex.quote(str(path))}")]


def _describe_fastest(timed_runs: Sequence[RunTimes], names: Mapping[str, str]) -> Iterator[str]:
    return (
        words
        for compared in compare_runs(timed_runs)
        for words, _ in equal_accuracy.describe_comparison(compared, names)
    )


def _describe_iteration_limits(ok_runs: Sequence[RunTimes]) -> Iterator[str]:
    """Describe how many runs the iteration limit stopped above round-off."""
    limited = [run for run in ok_runs if run.termination_reason == "max-iter" and not _is_at_roundoff(run)]
    if limited:
        many = f"All {len(ok_runs)} runs" if len(limited) == len(ok_runs) else f"{len(limited)} of {len(ok_runs)} runs"
        yield f"{many} stopped at the limit of iterations, at no tolerance: where they agree, all may be wrong alike."


def _is_at_roundoff(run: RunTimes) -> bool:
    return run.worst_residual is not None and run.worst_residual <= (run.roundoff_residual or 0.0)


def _describe_unsolved(ok_runs: Sequence[RunTimes], names: Mapping[str, str]) -> Iterator[str]:
    """Describe the remaining residual of methods that do not minimise.

    It is the one that the independent check measured.
    """
    for run in ok_runs:
        if run.max_stationarity_audit is not None and run.max_stationarity_audit > SOLVED_RESIDUAL:
            yield (
                f"{names[run.run_id]} on {run.scene} {run.size or ''}".rstrip()
                + " does not converge to the minimum of a step's objective: up to "
                f"{run.max_stationarity_audit:.1e} of the residual at a "
                "step's start is left (column `stationarity_audit`); more iterations need not lower it."
            )


def _describe_strain_growth(ok_runs: Sequence[RunTimes], names: Mapping[str, str]) -> Iterator[str]:
    """Describe how the largest strain and the material change with the mesh.

    Only runs that differ in nothing else and were solved to a tolerance or to round-off are compared.
    """
    sizes: dict[str, dict[str, dict[int, RunTimes]]] = defaultdict(lambda: defaultdict(dict))
    for run in ok_runs:
        solved = run.termination_reason in ("converged", "roundoff") or _is_at_roundoff(run)
        if solved and run.max_strain is not None and run.strain_p99:
            sizes[run.scene][names[run.run_id]][run.size] = run
    for scene, by_name in sizes.items():
        of_one = max(by_name.values(), key=len)
        coarse, fine = of_one[min(of_one)], of_one[max(of_one)]
        if words := _compare_strains(coarse, fine):
            yield f"{scene}: {words}"


def _compare_strains(coarse_run: RunTimes, fine_run: RunTimes) -> str:
    """Compare the strains of two sizes in words; empty if they do not differ notably."""
    largest, finest = coarse_run.max_strain or 0.0, fine_run.max_strain or 0.0
    most, below = coarse_run.strain_p99 or 1.0, fine_run.strain_p99 or 1.0
    change = f"from {100 * largest:.3g} to {100 * finest:.3g} %, from size {coarse_run.size} to {fine_run.size}"
    if (
        coarse_run.modulus_exponent
        and not 1 / STRAIN_GROWTH_FACTOR <= finest / (largest or 1.0) <= STRAIN_GROWTH_FACTOR
    ):
        power = "" if coarse_run.modulus_exponent == 1 else f"^{coarse_run.modulus_exponent}"
        return (
            f"the largest strain changes {change}, and so does the material: by the springs' rule its modulus is "
            f"proportional to h{power}, h the spacing of the mesh; `scaling_rule: continuum` does not change it."
        )
    if finest <= STRAIN_GROWTH_FACTOR * largest:
        return ""
    same = "the material is the same, but " if coarse_run.modulus_exponent == 0 else ""
    bound = f"where 99 % of the springs stay below {100 * most:.3g} and {100 * below:.3g} %"
    if finest / largest > STRAIN_GROWTH_FACTOR * below / most:
        return (
            f"the largest strain grows with the mesh, {change}, {bound}: {same}a single vertex that bears a load, such "
            "as a pin, is a point load, near which strain has no limit."
        )
    return (
        f"the largest strain grows with the mesh, {change}, {bound}: {same}strains have not converged by these sizes."
    )


def _describe_dissipation(ok_runs: Sequence[RunTimes], names: Mapping[str, str]) -> Iterator[str]:
    """Describe the energy dissipated by integrators and unconverged solves, where it is largest.

    Each scene, integrator and time step is represented by a run of the largest mesh: the one whose solves changed the
    energy least. A solver that integrates frames itself counts as an integrator.
    """
    chosen: dict[tuple[str, str, float], RunTimes] = {}
    for run in sorted(ok_runs, key=lambda run: (run.size, -abs(run.solve_share or 0.0))):
        if run.dissipation_shares and run.integrator and run.time_step:
            chosen[run.scene, _name_integrator(run), run.time_step] = run
    notable = [run for run in chosen.values() if abs(_integration_share(run)) >= NOTABLE_SHARE]
    notable.sort(key=lambda run: -abs(_integration_share(run)))
    for run in notable[:MAX_DISSIPATION_SENTENCES]:
        yield f"{run.scene}: {_describe_losses(run)}"
    if (more := len(notable) - MAX_DISSIPATION_SENTENCES) > 0:
        columns = "columns `dissipation_integrator` and `dissipation_engine`"
        yield f"Integrators took less in {more} other cases ({columns})."
    unsolved = [run for run in ok_runs if abs(run.solve_share or 0.0) >= NOTABLE_SHARE]
    if unsolved:
        run = max(unsolved, key=lambda run: abs(run.solve_share or 0.0))
        share = run.solve_share or 0.0
        yield (
            f"Unconverged solves {'took' if share > 0 else 'added'} up to {format_energy_share(share)} of the energy "
            f"({names[run.run_id]} on {run.scene}{f' {run.size}' if run.size else ''}, column `dissipation_solve`): "
            "more iterations change the motion."
        )


def _describe_losses(run: RunTimes) -> str:
    """Describe the energy balance of a run, in words."""
    words = describe_losses(
        _name_integrator(run),
        (run.frames or 0) * (run.time_step or 0.0),
        _integration_share(run),
        *(run.dissipation_shares or (0.0, 0.0))[:2],
        by_engine=run.engine_share is not None,
    )
    if run.integrator == "implicit-euler" and _has_steps_of_integrator(run):
        return f"{words}; half the time step takes about half of that, and midpoint none of a linear motion."
    return f"{words}."


def _name_integrator(run: RunTimes) -> str:
    """Return the integrator of a run; the solver, where it integrates frames itself."""
    return (run.integrator or "") if _has_steps_of_integrator(run) else run.solver


def _has_steps_of_integrator(run: RunTimes) -> bool:
    """Return whether a solver minimised the steps of an integrator; others have no unconverged solves."""
    return run.solve_share is not None


def _integration_share(run: RunTimes) -> float:
    """Return the share that the integrator dissipated, including the solves of an engine."""
    return (run.integrator_share if run.engine_share is None else run.engine_share) or 0.0


def _choose_recording(timed_runs: Sequence[RunTimes], recordings: Path) -> Path | None:
    """Return a recording of the largest mesh.

    It is that of the fastest run at equal accuracy, where runs were compared.
    """
    best = {compared.equal_runs[0].run_id for compared in compare_runs(timed_runs) if compared.equal_runs}
    timed = [run for run in timed_runs if run.step]
    order = sorted(timed, key=lambda run: (-(run.vertices or 0), run.run_id not in best, run.step))
    there = (next(recordings.glob(f"*-{escape(run.run_id)}.rrd"), None) for run in order)
    return next(filter(None, there), None)


def _find_scene_file(config: Path, name: str) -> Path | None:
    """Return the scene's file if it is in one of the usual folders, else None."""
    known = (config, *(folder / f"{name}.yaml" for folder in (config.parent, config.parent / "scenes")))
    return next((path for path in known if path.stem == name and path.is_file()), None)
