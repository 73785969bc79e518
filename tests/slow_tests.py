"""What takes long enough to be left to the CI: `slow.txt` names it, and a run of all tests finds it; `KINDS` are what
no one would call slow once all is compiled, and what a first run on a fresh machine would wait for.

    pytest -n 2 --dist loadfile -m 'not long' --find-slow 0.3      on an idle machine, with all kernels compiled

A line is a test, with or without its parameters, or a whole file. A file is, where tests share what takes long to make:
the next of them would make it.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS_FOLDER = Path(__file__).parent
SLOW_LIST = TESTS_FOLDER / "slow.txt"

SLOW_NAME_PARTS = (
    *("float16", "float32", "eigen", "cholmod"),  # kernels of their own, and programs in C++
    "cuda/",  # in a simulator, which is Python
    *("newton, absolute", "newton, trust-region", "newton, progressive"),  # what `newton, clamp` does, but for a rule
    *(
        "bench/test_exact.py",
        "unit/test_speed.py",
        "oracles/test_planted_errors.py",
        "oracles/test_obstacle_surfaces.py",
    ),
    *(
        "unit/test_vbd_elements.py",
        "refuse_by_name[vbd-",
        "test_a_balloon_of_a_thousand",
        "test_gas_is_minimised_where_its_sparse",
        *("effects-dashpots-1e6-vbd", "effects-dashpots-1e12-vbd"),
        *("effects-strain-limits-1e13-vbd", "effects-strain-limits-1e18-vbd", "effects-strain-limits-rigid-vbd"),
    ),  # a kernel for each set of effects
    *("test_a_factor_in_single_precision", "test_compiled.py::test_no_iter", "test_compiled.py::test_all_vertices_may"),
    *("stability/test_hard_solutions.py", "stability/test_properties", "contracts/test_backends_agree.py"),
)
"""Parts of names of slow tests that are not in the list."""

LONG_NAME_PARTS = (
    *("test_no_client_without_the_certificate", "test_each_run_is_done_by_one_of_two_commands"),
    *("resumes_where_it_was[without pictures]", "names_its_origin[entry-point]"),
    *("[100000 brackets]", "[10001 keys]", "stationary_as_reported[topology-degree-1000]", "never_passes_it[0.0-pncg]"),
    "serves_all_steps_of_a_system[cloth large enough for threads",
    *("refuse_by_name[anderson-dashpots]", "refuse_by_name[numba-dashpots]", "refuse_by_name[avbd-rayleigh]"),
    *(
        "refuse_by_name[avbd-strain limits]",
        "test_a_full_disk_is_a_failure_and",
        "test_a_balloon_of_a_thousand_vertices",
    ),
    *("the_path_to_it_are_intersection_free[newton]",),
    *("blocks of 3000 bytes-supernodal", "test_a_program_that_takes_twice_as_long", "in_any_order_of_imports"),
    *("test_a_config_next_to_files_of_these_names", "is_as_stationary_as_reported[effects-dashpots-1e12]"),
    "test_an_impact_that_the_steps_do_not_resolve_has_no_reference",
    *("failed_runs_are_repeated[200k]", "test_pictures_are_drawn_later_without", "is_recorded[nothing]"),
    *(
        "a_lost_drawing_process",
        "whichever_method_wins[chain-5-0.5-0.0001]",
        "whichever_method_wins[chain-5-0.5-0.001]",
        "whichever_method_wins[single-spring",
    ),
    *(
        "an_example_runs[own_report]",
        "have_order_1[surface-contact]",
        "have_order_1[self-contact]",
    ),
    *(
        "its_files_and_nothing_else[without pictures]",
        "blocks of 30000 bytes-supernodal, float16",
        "is_recorded[falls]",
    ),
    *("topology-degree-1000-numba float32", "topology-degree-1000-jgs2", "effects-dashpots-1e12-a-jacobi"),
    *("stiffness-number-1e12-symplectic-euler", "stiffness-number-1e12-velocity-verlet", "a held block at random-jgs2"),
    *("supernodal-float16-cloth-Anderson", "never_passes_it[6.0-pncg]", "a hanging cloth in a line-jgs2"),
    *("test_rerun_gaps.py", "test_a_limit_to_the_size_of_files", "1-cloth-numba, supernodal in float16"),
    *("up_to_there[memory runs out]", "up_to_there[a factorisation fails]", "minimum[both, and contact-plain]"),
)
"""Parts of names of tests that take 10 to 40 s; `pytest -m long` runs them."""


def read_slow_names() -> frozenset[str]:
    """The lines."""
    return frozenset(SLOW_LIST.read_text(encoding="utf-8").split("\n")) - {""}


def mark_slow_tests(items: list[pytest.Item]) -> None:
    """Mark items `long` by LONG_NAME_PARTS and `slow` by the list, unless they are long already."""
    slow = read_slow_names()
    find_long, find_slow = (
        re.compile("|".join(map(re.escape, parts))).search for parts in (LONG_NAME_PARTS, SLOW_NAME_PARTS)
    )
    for item in items:
        if item.get_closest_marker("long"):
            continue
        name = item.nodeid
        if find_long(name):
            item.add_marker(pytest.mark.long)
        elif slow & {name, name.partition("[")[0], name.partition("::")[0]} or find_slow(name):
            item.add_marker(pytest.mark.slow)


class SlowTestFinder:
    """Adds up what each test takes, and writes the list in the end."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._tests: dict[str, float] = {}
        self._files: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        name = report.nodeid
        if report.when == "setup" and report.duration > self._limit:
            self._files.add(name.partition("::")[0])
        self._tests[name] = self._tests.get(name, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        slow = {name for name, seconds in self._tests.items() if seconds > self._limit}
        alone = {name for name in slow if name.partition("::")[0] not in self._files}
        SLOW_LIST.write_text("\n".join(sorted(self._files | alone)) + "\n", encoding="utf-8")
