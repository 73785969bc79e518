"""Command `springbench matrices`: print and export the matrices of a scene."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from springbench.harness.cli.shared_options import SCENE_HELP, describe_config
from springbench.harness.console import print_message, show_activity
from springbench.harness.errors import InputError
from springbench.harness.execution.isolated_call import run_isolated

if TYPE_CHECKING:
    from springbench.harness.execution.worker_process import ProgressCallback
    from springbench.harness.scenes.scene_spec import SceneSpec


def matrices(
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    frame: Annotated[int, typer.Option(min=1, max=10_000, help="Number of the step that y, d and b belong to.")] = 1,
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            help="Matrix of another program, named A.mtx, C.mtx, M.mtx, Q.mtx, y.mtx, d.mtx or b.mtx; repeatable."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the files; SCENE-matrices by default.")
    ] = None,
) -> None:
    """Print the matrices and vectors of a scene, and write them with a picture.

    These are E, A, C, M, Q, y, d and b. They are written as .npz and as Matrix Market files.
    """
    folder = output or Path(f"{scene.stem}-matrices")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--output: got {folder}, a file; expected a folder, which is made if it is missing")

    show_activity("building the matrices")
    from springbench.harness.config.config_loader import load_scene_run
    from springbench.harness.config.user_code import DEFAULT_LOAD_LIMITS
    from springbench.harness.execution.worker_process import TaskLimits

    run = load_scene_run(scene, size)
    text, messages = run_isolated(
        partial(_write_matrices, run.scene, run.size, run.scene_name, frame, folder, compare or []),
        run.scene.find_plugins(),
        TaskLimits(*DEFAULT_LOAD_LIMITS),
    )
    for line in text:
        print(line)
    for line in messages:
        print_message(line)


def _write_matrices(
    spec: SceneSpec, size: int, name: str, frame: int, folder: Path, others: list[Path], tick: ProgressCallback
) -> tuple[list[str], list[str]]:
    """Write the files, and return the printed matrices and the messages."""
    from springbench.harness.experiments.grading.local_global_matrices import (
        build_local_global_matrices,
        format_matrices,
        save_matrices,
    )
    from springbench.harness.experiments.grading.matrix_comparison import compare_matrix_file
    from springbench.harness.experiments.grading.spring_terms import build_graded_scene
    from springbench.harness.report.sparsity_plot import draw_sparsity

    made = build_local_global_matrices(build_graded_scene(spec, size), frame, spec.initial_guess)
    compared = [compare_matrix_file(made, path) for path in others]
    paths = save_matrices(made, folder)
    facts = [f"{made.terms.num_vertices} vertices, {len(made.E)} springs, {len(made.terms.pinned)} pins"]
    facts += ["dark: positive entries", "orange: negative entries"]
    shown = {key: matrix for key, matrix in made.sparse_matrices.items() if matrix.shape[0]}
    picture = draw_sparsity(shown, folder / "sparsity.png", f"Matrices of {name}{f' {size}' if size else ''}", facts)
    text = [*format_matrices(made), *(["", *compared] if compared else [])]
    return text, [f"{', '.join(path.name for path in (*paths, picture))} are in {folder}"]
