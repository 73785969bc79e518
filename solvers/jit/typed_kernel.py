"""Calls of kernels whose argument types do not change, without the lookup of these types.

In each call Numba determines the types of all arguments. For a state of 60 arrays that takes eight times as long as the
call itself. A prepared solver passes the same types in each step, so the compiled code is selected once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core.typing.typeof import Purpose, typeof
from numpy.typing import NDArray


def as_kernel_array(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x if it is contiguous and writable, else a copy.

    Kernels are compiled for contiguous, writable arrays.
    """
    return x if x.flags.carray else np.array(x, np.float64, order="C")


class TypedKernel:
    """A kernel whose arguments have the types of the first call in all others.

    Arguments of other types are misread without an error: arrays must be made with a fixed type and layout.

    Attributes:
        kernel: the kernel, for arguments of any types.
        call: function of the arguments.
    """

    __slots__ = ("call", "kernel")

    def __init__(self, kernel: Any) -> None:
        """Create a call of a kernel, which is compiled when it is first needed."""
        self.kernel, self.call = kernel, self._call_first

    def _call_first(self, *arguments: Any) -> Any:
        """Call the kernel, and select the compiled code for the types of the arguments."""
        answer = self.kernel(*arguments)
        self.call = self._find_compiled_code(arguments).entry_point
        return answer

    def _find_compiled_code(self, arguments: tuple[Any, ...]) -> Any:
        """Return the compiled code for arguments with which the kernel has been called.

        The types of the arguments are determined only if there is a choice: for a state of 60 arrays this takes 2 ms.
        """
        overloads = self.kernel.overloads
        if len(overloads) == 1:
            return next(iter(overloads.values()))
        return overloads[tuple(typeof(argument, Purpose.argument) for argument in arguments)]
