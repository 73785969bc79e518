"""A run of one solver, whose row is printed: whether the product detects an error by itself.

python -m tests.mutations.product SOLVER
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles

SCENE = """
mesh: {kind: grid}
mass: 1.0
time_step: 1/30
frames: 7
default_size: 40
effects: [{kind: springs, stretch: 100}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
"""Its times are long enough that a thousandth of them is not within a millisecond."""


def main(solver: str) -> None:
    """Print the status and the reason of the run's first row."""
    with TemporaryDirectory() as home:
        folder = Path(home)
        (folder / "scene.yaml").write_text(SCENE)
        (run,) = load_config(
            folder / "scene.yaml", solvers=[solver], max_iterations=60, rounds=1, threads=1
        ).list_runs()
        files = RunFiles.for_run(run, folder)
        files.rows_path.parent.mkdir()
        first = execute_run(run, files, lambda phase: None)[0]
    print(f"{first['status']}: {first.get('reason', '')}")


if __name__ == "__main__":
    main(sys.argv[1])
