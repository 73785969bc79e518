"""Lies in what runs on a device; their tests run in Numba's simulator."""

from __future__ import annotations

from tests.mutations.base import Mutation

_STEPPING = "solvers/cuda/stepping_kernels.py"
_STEPS = "tests/cuda/test_steps.py::test_steps_are_those_of_the_processor"

DEVICE = (
    Mutation(
        "device-speed-is-the-mean",
        _STEPPING,
        "2.0 * x - here, 2.0 * w - speed",
        "2.0 * x - here, w",
        (_STEPS,),
    ),
    Mutation(
        "device-drag-of-another-place",
        _STEPPING,
        "weights.rate * drag[i] * origin",
        "weights.rate * drag[i] * here",
        (_STEPS,),
    ),
    Mutation(
        "device-grip-without-coefficient",
        "solvers/cuda/pair_kernels.py",
        "grips.force[e], grips.own[e] = friction * force[0], corners_of(found)",
        "grips.force[e], grips.own[e] = force[0], corners_of(found)",
        ("tests/cuda/test_pairs.py",),
    ),
    Mutation(
        "device-depth-of-the-other-side",
        "solvers/cuda/half_space_kernels.py",
        "depth = when * (spaces.offset[k] - lagged)",
        "depth = when * (lagged - spaces.offset[k])",
        ("tests/cuda/test_touching.py",),
    ),
    Mutation(
        "device-tension-forgotten",
        "solvers/cuda/xpbd_kernels.py",
        "springs.tension[e] += change",
        "springs.tension[e] = change",
        ("tests/cuda/test_xpbd.py",),
    ),
)
