"""Planted errors in what runs on a device; their tests run in Numba's simulator."""

from __future__ import annotations

from tests.mutations.base import Mutation

DEVICE = (
    Mutation(
        "device-depth-of-the-other-side",
        "solvers/methods/vertex_block/device_half_spaces.py",
        "depth = when * (spaces.offset[k] - lagged)",
        "depth = when * (lagged - spaces.offset[k])",
        ("tests/cuda/test_touching.py",),
    ),
    Mutation(
        "device-tension-forgotten",
        "solvers/methods/position_based/device_xpbd_kernels.py",
        "springs.spring_tensions[e] += change",
        "springs.spring_tensions[e] = change",
        ("tests/cuda/test_xpbd.py",),
    ),
)
