"""C++ baseline, `cpp_baseline.cpp`, called for one step at a time.

It is compiled where a compiler and Eigen exist.

The scene is passed in a file: int64 n, m, q; float64 dt; int64 edges (m, 2), pinned (q,); float64 stiffness, rest
length (m,), mass (n,), pin weight (q,), target, force, initial guess (n, 3), pin targets (q, 3).
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
from springbench.harness.errors import RunFailed
from springbench.solvers.methods.local_global.cpp_backend import compile_cpp
from springbench.solvers.methods.local_global.eigen_local_global import EIGEN_REQUIREMENTS
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem, Unsupported

CPP_SOURCE = Path(__file__).with_name("cpp_baseline.cpp")

MALLOC_TUNABLES = ":".join(
    f"glibc.malloc.{setting}"
    for setting in ("hugetlb=1", "mmap_threshold=1073741824", "trim_threshold=4294967296", "top_pad=67108864")
)
"""Settings of the GNU C library for cheap temporaries: transparent huge pages, and freed memory is not returned."""

EXIT_MESSAGES = {
    2: "expected a scene and a file for positions",
    3: "the scene's file is too short",
    4: "Q has no factor",
}


def compile_baseline(folder: Path) -> Path:
    """Compile the baseline in `folder`; again if its source has changed.

    Raises Unsupported with the reason.
    """
    return compile_cpp(CPP_SOURCE, folder, EIGEN_REQUIREMENTS)


class CppBaseline:
    """Running baseline program with one step problem of springs."""

    def __init__(self, program: Path, problem: StepProblem, springs: Springs, folder: Path, tunables: str) -> None:
        """Start the program and factorise.

        Args:
            program: the compiled program.
            problem: the step problem.
            springs: the springs of the scene.
            folder: folder for the files of the program.
            tunables: settings of the C library.

        Raises:
            Unsupported: a pin is not a penalty.
            RunFailed: the program ended.
        """
        if problem.system.pins.exact_mask.any():
            raise Unsupported("the C++ baseline supports pins by penalty only")
        scene, self._positions = folder / "scene.bin", folder / "positions.bin"
        write_problem(scene, problem, springs)
        self._shape = problem.inertial_target.shape
        self._process = subprocess.Popen(
            [program, scene, self._positions],
            env={**os.environ, "GLIBC_TUNABLES": tunables},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.prepare_seconds = self._read_answer()[0]
        scene.unlink()

    def time_step_phases(self, iterations: int) -> list[float]:
        """Time one step with a number of iterations, from the initial guess, and its phases.

        Returns:
            Wall seconds of the whole step, of its local steps, and of its global steps. Raises RunFailed.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{iterations}\n")
            self._process.stdin.flush()
        except OSError:  # the program has ended; its exit code states the reason
            pass
        return self._read_answer()

    def close(self) -> Positions:
        """End the program and return the positions (n, 3) [m] of its last step.

        Raises RunFailed.
        """
        assert self._process.stdin is not None
        self._process.stdin.close()
        if self._process.wait():
            raise self._build_error()
        p = np.fromfile(self._positions).reshape(self._shape)
        self._positions.unlink()
        return p

    def kill_process(self) -> None:
        """Kill the program in any state."""
        self._process.kill()
        self._process.wait()

    def _read_answer(self) -> list[float]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            raise self._build_error()
        return [float(word) for word in line.split()]

    def _build_error(self) -> RunFailed:
        code = self._process.returncode
        return RunFailed(f"the C++ baseline ended with {code}: {EXIT_MESSAGES.get(code, 'out of memory or killed')}")


def write_problem(path: Path, problem: StepProblem, springs: Springs) -> None:
    """Write a step problem of springs in the binary format of the program.

    Args:
        path: file to write.
        problem: step problem, of whose system the time step, the masses and the pins are written.
        springs: springs of the scene.
    """
    system = problem.system
    parts = [
        np.array([system.num_vertices, len(springs.edges), len(system.pins.vertices)], np.int64),
        np.array([system.time_step]),
        springs.edges.astype(np.int64),
        system.pins.vertices.astype(np.int64),
        *(springs.stiffness, springs.rest_length, system.mass, system.pins.weight),
        *(problem.inertial_target, problem.external_force, problem.initial_guess, problem.pin_targets),
    ]
    with path.open("wb") as file:
        for part in parts:
            np.ascontiguousarray(part).tofile(file)
