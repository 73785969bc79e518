"""Reader of numeric arrays in untrusted .npz and .npy files.

The files are read in a sandboxed subprocess within limits. The whole array is read, so that its checksum is verified.
Pickles, other types, and by default NaN and infinities are rejected.
"""

from __future__ import annotations

import io
import zipfile
from math import prod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from springbench.harness.atomic_files import HEAD_BYTES, describe_cause, describe_misnamed_file
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox

MAX_NPZ_BYTES = 100_000_000
"""Maximum size of an array in float64, and of a file [bytes].

Scenes contain such numbers as text, which takes 17 times as much.
"""
_BASE_SECONDS, _BYTES_PER_SECOND = 5.0, 2e7
_MEMORY_LIMIT = 2**28 + 3 * MAX_NPZ_BYTES


def read_npz_array(path: Path, name: str, *, allows_nonfinite: bool = False) -> NDArray[np.float64]:
    """Read one array of an .npz file as float64.

    Args:
        path: the .npz file.
        name: name of the array.
        allows_nonfinite: whether NaN and infinities are accepted.

    Returns:
        C-contiguous array.

    Raises:
        InputError: if the file or the array is invalid; it names the file.
    """
    check_data_file(path, ".npz")
    try:
        return sandbox.call_in_sandbox(_extract_array, path, name, allows_nonfinite, limits=_build_limits())
    except sandbox.SandboxError as error:
        raise InputError(
            InputMistake(f"cannot be read as an .npz file with an array `{name}`: {error}", path)
        ) from None


def read_npy_array(path: Path, *, allows_nonfinite: bool = False) -> NDArray[np.float64]:
    """Read the array of an .npy file as float64, like `read_npz_array`.

    Args:
        path: the .npy file.
        allows_nonfinite: whether NaN and infinities are accepted.

    Raises:
        InputError: the file or the array is invalid; it names the file.
    """
    check_data_file(path, ".npy")
    try:
        return sandbox.call_in_sandbox(_read_npy, path, allows_nonfinite, limits=_build_limits())
    except sandbox.SandboxError as error:
        raise InputError(InputMistake(f"cannot be read as an .npy file: {error}", path)) from None


def check_data_file(path: Path, suffix: str) -> None:
    """Raise InputError unless a path is a regular data file within the size limit.

    Args:
        path: path of the file.
        suffix: expected suffix with its dot, for the message.

    Raises:
        InputError: it is no regular file, is too large, is empty, or contains a Git LFS pointer or a web page.
    """
    try:
        if not path.is_file():
            raise InputError(InputMistake(f"is no file; give the path of an {suffix} file", path))
        size = path.stat().st_size
        with path.open("rb") as file:
            problem = describe_misnamed_file(file.read(HEAD_BYTES), size)
    except (OSError, ValueError) as error:
        raise InputError(InputMistake(f"cannot be read: {describe_cause(error)}", path)) from None
    if size > MAX_NPZ_BYTES:
        problem = f"has {size:,} bytes; at most {MAX_NPZ_BYTES:,} are read"
    if problem:
        raise InputError(InputMistake(problem, path))


def _build_limits() -> sandbox.CallLimits:
    return sandbox.CallLimits(_BASE_SECONDS + MAX_NPZ_BYTES / _BYTES_PER_SECOND, _MEMORY_LIMIT)


def _read_npy(path: Path, allows_nonfinite: bool) -> NDArray[np.float64]:
    """Read an .npy file in the sandbox."""
    return _parse_npy(path.read_bytes(), InputMistake("its array", path), allows_nonfinite)


def _extract_array(path: Path, name: str, allows_nonfinite: bool) -> NDArray[np.float64]:
    """Extract an array in the sandbox.

    Raise InputError, or errors of the standard library for a broken file.
    """
    try:
        with zipfile.ZipFile(path) as packed:
            names = [info.filename.removesuffix(".npy") for info in packed.infolist()]
            found = [info for info in packed.infolist() if info.filename == f"{name}.npy"]
            if len(found) != 1:
                there = f"; it contains {', '.join(x[:40] for x in names[:5])}" if names else ""
                raise InputError(InputMistake(f"contains {len(found)} arrays `{name}`, expected one{there}", path))
            if found[0].flag_bits & 1:
                raise InputError(InputMistake("is encrypted; store it without a password", path))
            if found[0].file_size > MAX_NPZ_BYTES:
                problem = f"its array `{name}` takes {found[0].file_size:,} bytes; at most {MAX_NPZ_BYTES:,} are read"
                raise InputError(InputMistake(problem, path))
            content = packed.read(found[0])  # the checksum is verified only at the end
    except zipfile.BadZipFile as error:
        raise InputError(InputMistake(f"is no whole .npz file ({error}); write it once more", path)) from None
    return _parse_npy(content, InputMistake(f"its array `{name}`", path), allows_nonfinite)


def _parse_npy(content: bytes, what: InputMistake, allows_nonfinite: bool) -> NDArray[np.float64]:
    """Parse the content of an .npy file; raise InputError if it is invalid."""

    def refuse(problem: str) -> InputError:
        return InputError(InputMistake(f"{what.problem} {problem}", what.file))

    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read_header(file)
    except ValueError as error:
        raise refuse(f"has no head of an array ({error})") from None
    if dtype.kind not in "fiu":
        raise refuse(f"contains values of type {dtype}; expected real numbers")
    if any(not isinstance(n, int) or n < 0 for n in shape):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise refuse(f"has the shape {shape}; expected whole numbers")
    count, begun = prod(shape), file.tell()
    if count * dtype.itemsize != len(content) - begun:
        raise refuse(f"declares {count * dtype.itemsize:,} bytes, and {len(content) - begun:,} are there")
    if 8 * count > MAX_NPZ_BYTES:
        raise refuse(f"has {count:,} numbers; at most {MAX_NPZ_BYTES // 8:,} are read")
    with np.errstate(over="ignore"):
        numbers = np.frombuffer(content, dtype, count, begun).astype(np.float64)
    if not (allows_nonfinite or np.isfinite(numbers).all()):
        at = int(np.flatnonzero(~np.isfinite(numbers))[0])
        raise refuse(f"contains {numbers[at]} (number {at:,} from 0); expected finite numbers")
    return np.ascontiguousarray(numbers.reshape(shape, order="F" if is_fortran else "C"))
