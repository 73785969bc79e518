"""Hard cases by all methods on a device, in both precisions: right, or refused by name. Some of them here; all where
`-m long` selects them; it prints the outcome of each.
"""

from __future__ import annotations

from collections import Counter

import pytest

from tests.cuda.hard import METHODS, ROUND_OFF, Precision, outcome
from tests.stability.test_hard_scenes import CASES, scene

SOME = {
    "geometry-collapsed": ("xpbd", "vbd"),
    "geometry-zero-rest-lengths": ("vbd", "newton-cg"),
    "numbers-1e6-m-away": ("xpbd-small-steps", "newton-cg"),
    "numbers-mass-ratio-1e8": ("xpbd", "newton-cg"),
    "numbers-massless-vertices": ("xpbd", "newton-cg"),
    "scales-links-1e12": ("vbd",),
    "motion-pins-jump-exact": ("vbd", "xpbd"),
    "topology-all-pins-exact": ("newton-cg", "vbd", "xpbd-small-steps"),
    "topology-single-vertex": tuple(METHODS),
    "effects-dashpots-1e12": ("vbd",),
    "contact-resting-block": ("newton-cg", "xpbd"),
}
"""A few of each kind, and the methods that are tested."""

precisions = pytest.mark.parametrize("precision", ROUND_OFF)


SHORT_OF_DIGITS: dict[tuple[str, Precision], set[str]] = {("newton-cg", "float32"): {"effects-bending-1e12"}}
"""Cases for which float32 has too few digits: the bending is 1e12 times as stiff as the springs. In the simulator this
case is right by a narrow margin; an NVIDIA H200, which fuses products and sums, descends by nothing in float32."""


@precisions
@pytest.mark.parametrize(("case", "method"), [(case, method) for case, each in SOME.items() for method in each])
def test_a_hard_case_is_right_or_refused(case: str, method: str, precision: Precision) -> None:
    found = outcome(scene(case), method, precision)
    assert found.word in ("right", "refused"), found


@pytest.mark.long
@precisions
@pytest.mark.parametrize("method", METHODS)
def test_every_hard_case_is_right_or_refused(method: str, precision: Precision) -> None:
    found = {case: outcome(scene(case), method, precision) for case in CASES}
    print(f"\n{method}, {precision}: {dict(Counter(one.word for one in found.values()))}")
    for case, one in found.items():
        if one.word != "right" or one.over > 0.3:
            print(f"  {case}: {one.word}, {one.why}")
    known = SHORT_OF_DIGITS.get((method, precision), set())
    assert {case: one for case, one in found.items() if one.word == "wrong" and case not in known} == {}
