"""Numba's CUDA target, or its simulator; Numba states no types for what kernels ask of it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

cuda: Any = import_module("numba.cuda")
