"""Ratios of times to a reference method: the same on a machine of any speed, with an interval."""

from typing import Any

import pytest
from springbench.harness.results.study_comparison import AgreementLevel, compare_time_ratios
from springbench.harness.results.time_ratios import OTHER_MACHINE_FACTOR, compute_time_ratios


def build_steps(solver: str, seconds: float, **other: Any) -> list[dict[str, Any]]:
    shared = {"scene": "cloth", "size": 8, "solver": solver, "parameters": "{}", "phase": "step"} | other
    return [shared | {"frame": frame, "seconds": seconds * (1 + 0.01 * frame)} for frame in range(1, 9)]


def test_a_ratio_refers_to_the_same_scene_and_the_first_reference_solver() -> None:
    rows = [*build_steps("numba", 1e-3), *build_steps("sparse", 4e-3), *build_steps("sparse", 9e-3, size=16)]
    (ratio,) = compute_time_ratios(rows)
    assert (ratio.method[0], ratio.reference[0], ratio.size) == ("sparse", "numba", 8)
    assert ratio.ratio == pytest.approx(4.0)
    assert ratio.low == pytest.approx(4.0 / OTHER_MACHINE_FACTOR)
    assert ratio.high == pytest.approx(4.0 * OTHER_MACHINE_FACTOR)


def test_simulations_are_compared_by_their_rounds() -> None:
    shared = {"kind": "work", "scene": "cloth", "size": 8, "parameters": "{}"}
    rows = [shared | {"solver": "numba", "seconds": [1.0, 1.1]}, shared | {"solver": "xpbd", "seconds": [0.5, 0.55]}]
    (ratio,) = compute_time_ratios(rows)
    assert ratio.ratio == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("speed", "slower", "level"),
    [(7.0, 1.0, AgreementLevel.CLOSE), (1.0, 1.9, AgreementLevel.CLOSE), (1.0, 2.2, AgreementLevel.DIFFERENT)],
)
def test_only_ratios_beyond_the_interval_differ(speed: float, slower: float, level: AgreementLevel) -> None:
    published = compute_time_ratios([*build_steps("numba", 1e-3), *build_steps("sparse", 4e-3)])
    here = compute_time_ratios([*build_steps("numba", 1e-3 * speed), *build_steps("sparse", 4e-3 * speed * slower)])
    (found,) = compare_time_ratios(published, here)
    assert found.level is level


def test_steps_without_a_time_have_no_ratio() -> None:
    rows = [row | {"seconds": None} for row in build_steps("numba", 1.0)]
    assert compute_time_ratios([*rows, *build_steps("sparse", 1.0)]) == []
