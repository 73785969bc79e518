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
    Mutation(
        "device-compressed-springs-stiffen",
        "solvers/methods/vertex_block/device_vbd_kernels.py",
        "lateral = zero if tension > zero and inward > zero else -tension",
        "lateral = -tension",
        ("tests/cuda/test_vbd.py",),
    ),
    Mutation(
        "device-force-of-the-rest-shape",
        "solvers/cuda/device_springs.py",
        "longer = ((d0 + v0) * w0 + (d1 + v1) * w1 + (d2 + v2) * w2) / (was + length)",
        "longer = 2.0 * (d0 * w0 + d1 * w1 + d2 * w2) / (was + length)",
        ("tests/cuda/test_vbd.py",),
    ),
    Mutation(
        "device-any-step-descends",
        "solvers/methods/newton/device_newton_cg.py",
        "if is_armijo_step(rise, t, slope, 0.0):",
        "if True:",
        ("tests/cuda/test_newton_cg.py",),
    ),
)
