"""Planted errors in measuring, recordings and pictures.

The product must detect those with a third part too: by a run of that solver, whose row gives the reason.
"""

from __future__ import annotations

from tests.mutations.base import Mutation

_RERUN, _RENDER = "harness/recording/rerun_recorder.py", "harness/report/mesh_rendering.py"
_FALSE_REPORTS, _RECORDINGS = "tests/contracts/test_false_reports.py", "tests/contracts/test_recordings.py"
_UNIT_STEP, _UNIT_MEASURE, _UNIT_CLOCK = (f"tests/unit/test_{name}.py" for name in ("simulate", "phase_times", "clock"))
_PICTURES, _PHASES = (
    "tests/unit/test_report_pictures.py",
    "tests/contracts/test_solver_contract.py::test_each_phase_does_what_it_returns",
)
_TWO_CLOCKS = "add up to"

MEASURING = (
    Mutation(
        "steps-without-solve",
        "harness/simulation/stopwatch.py",
        "        self.seconds = perf_counter() - self._began\n",
        "        self._began = perf_counter()\n        self.seconds = perf_counter() - self._began\n",
        (_UNIT_STEP,),
        ("sparse", _TWO_CLOCKS),
    ),
    Mutation(
        "steps-scaled",
        "harness/simulation/stopwatch.py",
        "self.seconds = perf_counter() - self._began",
        "self.seconds = (perf_counter() - self._began) / 1000",
        (_UNIT_STEP,),
        ("sparse", _TWO_CLOCKS),
    ),
    Mutation(
        "phases-scaled",
        "harness/simulation/timing_pass.py",
        "round, b - a)",
        "round, (b - a) / 1000)",
        (_UNIT_MEASURE,),
        ("sparse", _TWO_CLOCKS),
    ),
    Mutation(
        "prepare-scaled",
        "harness/simulation/timing_pass.py",
        'TimingSample("prepare", None, round, seconds)',
        'TimingSample("prepare", None, round, seconds / 1000)',
        (_UNIT_MEASURE,),
        ("sparse", _TWO_CLOCKS),
    ),
    Mutation(
        "rows-scaled",
        "harness/simulation/timing_pass.py",
        '"seconds": t.seconds,',
        '"seconds": t.seconds / 1000,',
        (_UNIT_MEASURE,),
        ("sparse", _TWO_CLOCKS),
    ),
    Mutation(
        "global-does-nothing",
        "solvers/methods/local_global/prefactored.py",
        '"global": whole}',
        '"global": lambda: None}',
        (_PHASES,),
        ("sparse", "does nothing"),
    ),
    Mutation(
        "global-leaves-what-is-there",
        "solvers/methods/local_global/fused_local_global.py",
        '"global": lambda: self.base.solve_correction(y, out)}',
        '"global": lambda: out}',
        (_PHASES,),
        ("numba", "does nothing"),
    ),
    Mutation(
        "a-round-too-few",
        "harness/simulation/timing_pass.py",
        "    for round in range(settings.rounds):",
        "    for round in range(settings.rounds - 1):",
        (_UNIT_MEASURE,),
    ),
    Mutation(
        "tolerance-of-all",
        "harness/simulation/stopwatch.py",
        "CLOCK_RTOL, CLOCK_ATOL_SECONDS, CALL_OVERHEAD_SECONDS = 0.03",
        "CLOCK_RTOL, CLOCK_ATOL_SECONDS, CALL_OVERHEAD_SECONDS = 3.0",
        (_UNIT_CLOCK,),
    ),
    Mutation(
        "never-interrupted",
        "harness/simulation/stopwatch.py",
        '"preempted": self.preempted_seconds >',
        '"preempted": 0.0 >',
        (_UNIT_CLOCK,),
    ),
    Mutation(
        "phases-of-any-time",
        "harness/simulation/stopwatch.py",
        "PHASE_SUM_RTOL = 0.15",
        "PHASE_SUM_RTOL = 15.0",
        (_UNIT_MEASURE,),
    ),
    Mutation(
        "curves-scaled",
        "harness/experiments/accuracy/convergence_curves.py",
        "    stamps[1:] -= began\n",
        "    stamps[1:] -= began\n    stamps /= 1000.0\n",
        ("tests/unit/test_accuracy_curves.py",),
    ),
    Mutation(
        "turns-scaled",
        "harness/experiments/roofline/benchmark_candidates.py",
        "found = perf_counter() - began",
        "found = (perf_counter() - began) / 1000",
        ("tests/unit/test_speed.py::test_a_time_that_another_clock_contradicts_is_a_failure",),
    ),
    Mutation(
        "table-of-other-phase",
        "harness/report/timing_table.py",
        "median(seconds) filter (phase = 'local')",
        "median(seconds) filter (phase = 'global')",
        ("tests/unit/test_report_timing.py",),
    ),
    Mutation(
        "frame-late",
        _RERUN,
        "self._buffered.append((frame.index, p,",
        "self._buffered.append((frame.index, self._buffered[-1][1] if self._buffered else p,",
        (_RECORDINGS,),
        ("sparse", "other positions"),
    ),
    Mutation(
        "frame-of-the-start",
        "harness/simulation/instrumentation_pass.py",
        "scene.compute_time(step.index), step.positions, *drawn",
        "scene.compute_time(step.index), step.problem.step_start.positions, *drawn",
        (_FALSE_REPORTS,),
        ("sparse", "other positions"),
    ),
    Mutation(
        "colours-late",
        _RERUN,
        "p, self._shading.compute_colours(of_vertex)))",
        "p, self._buffered[-1][2] if self._buffered else self._shading.compute_colours(of_vertex)))",
        (_RECORDINGS,),
        ("sparse", "other colours"),
    ),
    Mutation(
        "colours-inverted",
        "harness/recording/strain_scale.py",
        "np.clip(strain / end, -1, 1)",
        "np.clip(-strain / end, -1, 1)",
        ("tests/unit/test_record_shading.py",),
        ("sparse", "other colours"),
    ),
    Mutation(
        "times-in-microseconds", "harness/recording/recording_reader.py", "counts / 1e9", "counts / 1e6", (_RECORDINGS,)
    ),
    Mutation(
        "recording-not-compared",
        "harness/recording/recording_check.py",
        "if recorded.positions.tobytes() != store_relative(p, origin).tobytes():",
        "if False:",
        ("tests/unit/test_record_verify.py",),
    ),
    Mutation(
        "passes-not-compared",
        "harness/experiments/run_pipeline.py",
        'if measured.final_positions is not None and found[run.frames]["positions_digest"] != '
        "hash_positions(\n            measured.final_positions\n        ):",
        "if False:",
        (_FALSE_REPORTS,),
    ),
    Mutation(
        "picture-of-other-colours",
        _RENDER,
        'mesh.point_data["strain"] = compute_vertex_strain(replay, frame)',
        'mesh.point_data["strain"] = compute_vertex_strain(replay, 0)',
        (_PICTURES,),
    ),
    Mutation(
        "net-of-other-colours",
        _RENDER,
        'lines.cell_data["strain"] = compute_spring_strain(replay, frame)',
        'lines.cell_data["strain"] = compute_spring_strain(replay, 0)',
        (_PICTURES,),
    ),
    Mutation(
        "picture-of-other-frame",
        _RENDER,
        "np.ascontiguousarray(unit * replay.positions[frame].astype(np.float64), np.float32)",
        "np.ascontiguousarray(unit * replay.positions[0].astype(np.float64), np.float32)",
        (_PICTURES,),
    ),
    Mutation(
        "processor-time-not-compared",
        "harness/simulation/stopwatch.py",
        "self.thread_seconds / 2 - total",
        "-total",
        (_UNIT_CLOCK,),
    ),
)
