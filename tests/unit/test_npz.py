"""Stored arrays from untrusted sources: read whole, or refused with the reason."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError
from springbench.harness.execution.npz_reader import MAX_NPZ_BYTES, read_npz_array

FRAMES = np.arange(24.0).reshape(2, 4, 3) / 7.0


def npy(array: np.ndarray, **options) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, **options)
    return file.getvalue()


def header(text: str, body: bytes = b"") -> bytes:
    """A .npy file with this head."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n" + body


def pack_arrays(**arrays: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in arrays.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def flip_bit(content: bytes) -> bytes:
    """Stored without compression, with one bit of a number turned."""
    file = io.BytesIO()
    np.savez(file, positions=FRAMES)
    whole = bytearray(file.getvalue())
    whole[whole.index(FRAMES.tobytes()) + 100] ^= 1
    return bytes(whole)


def mark_encrypted(content: bytes) -> bytes:
    """Marked as encrypted, in both heads of its one member."""
    whole = bytearray(content)
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        whole[whole.index(mark) + at] |= 1
    return bytes(whole)


WHOLE = pack_arrays(positions=npy(FRAMES))
NAN, WORDS = FRAMES.copy(), np.array([["a"]])
NAN[1, 2, 0] = np.nan
BROKEN_FILES: dict[str, tuple[bytes | Callable[[bytes], bytes], str]] = {
    "empty": (b"", "is empty"),
    "a pointer": (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
    "no archive": (b"positions", "no whole .npz"),
    "a bare array": (npy(FRAMES), "no whole .npz"),
    "cut": (lambda whole: whole[:-30], "no whole .npz"),
    "a flipped bit": (flip_bit, "Bad CRC-32"),
    "encrypted": (mark_encrypted, "encrypted"),
    "of another name": (
        pack_arrays(velocities=npy(FRAMES)),
        "contains 0 arrays `positions`, expected one; it contains velocities",
    ),
    "no member": (pack_arrays(), "contains 0 arrays"),
    "a member that is no array": (pack_arrays(positions=b"0 1 2"), "has no head of an array"),
    "pickled": (pack_arrays(positions=npy(np.array([FRAMES, None], object), allow_pickle=True)), "of type object"),
    "words": (pack_arrays(positions=npy(WORDS)), "of type <U1; expected real numbers"),
    "complex": (pack_arrays(positions=npy(FRAMES.astype(complex))), "of type complex128"),
    "a record": (pack_arrays(positions=npy(np.zeros(3, [("x", "f8")]))), "expected real numbers"),
    "NaN": (pack_arrays(positions=npy(NAN)), r"contains nan \(number 18 from 0\)"),
    "beyond float64": (pack_arrays(positions=npy(np.full((1, 1, 3), np.longdouble("1e400")))), "contains inf"),
    "fewer numbers than promised": (pack_arrays(positions=npy(FRAMES)[:-8]), "declares 192 bytes, and 184 are there"),
    "more numbers": (pack_arrays(positions=npy(FRAMES) + bytes(8)), "declares 192 bytes, and 200 are there"),
    "a negative shape": (
        pack_arrays(positions=header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 4, 3)}")),
        "the shape",
    ),
    "a vast shape": (
        pack_arrays(positions=header("{'descr': '<f8', 'fortran_order': False, 'shape': (10**6, 10**6, 3)}")),
        "no head of an array|declares",
    ),
    "a head of code": (pack_arrays(positions=header("__import__('os').system('true')")), "no head of an array"),
    "100 MB of zeros in 100 kB": (
        lambda _: pack_arrays(positions=npy(np.zeros(MAX_NPZ_BYTES // 8 + 1))),
        "at most 100,000,000 are read",
    ),
    "bytes that grow": (
        lambda _: pack_arrays(positions=npy(np.zeros(MAX_NPZ_BYTES // 8 + 1, np.uint8))),
        "at most 12,500,000 are read",
    ),
}


@pytest.mark.parametrize("case", BROKEN_FILES)
def test_a_broken_file_is_refused_with_the_reason(tmp_path, case):
    content, words = BROKEN_FILES[case]
    path = tmp_path / "walk.npz"
    path.write_bytes(content if isinstance(content, bytes) else content(WHOLE))
    with pytest.raises(InputError, match=words) as caught:
        read_npz_array(path, "positions")
    assert caught.value.mistakes[0].file == path


@pytest.mark.parametrize("dtype", ["f8", ">f8", "f4", "i2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_numbers_of_any_type_and_order_are_read_as_float64(tmp_path, dtype, order):
    stored = np.array(FRAMES, dtype, order=order)
    np.savez_compressed(tmp_path / "walk.npz", other=np.arange(3), positions=stored)
    found = read_npz_array(tmp_path / "walk.npz", "positions")
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, stored.astype(float))


@pytest.mark.parametrize("name", ["missing.npz", ".", "a\0b.npz"])
def test_a_path_that_is_not_a_file_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"is no file|cannot be read"):
        read_npz_array(tmp_path / name, "positions")


def scene(folder: Path, obstacle: str) -> Path:
    """A sheet above an obstacle."""
    path = folder / "scene.yaml"
    path.write_text(
        "mesh: {kind: grid}\ndefault_size: 4\nmass: 1\ntime_step: 0.01\nframes: 2\n"
        f"effects: [{{kind: springs, stretch: 1}}, {{kind: surface-contact, obstacles: [{obstacle}]}}]\n"
    )
    return path


@pytest.mark.parametrize(
    ("obstacle", "words"),
    [
        ("mesh: {kind: balloon}, size: 2, frames: {positions: cut.npz}", "cut.npz: is no whole .npz file"),
        ("mesh: {kind: balloon}, size: 2, frames: {positions: walk.npz}", "got 4 points for a mesh of 42"),
        (
            "mesh: {kind: balloon}, size: 2, frames: {positions: flat.npz}",
            r"flat.npz: got positions \(2, 12\)",
        ),
        ("mesh: {kind: file, path: broken.obj}", "broken.obj:1: 'x' is no number"),
        ("mesh: {kind: file, path: broken.ply}", "broken.ply: cannot be read as a mesh"),
    ],
)
def test_a_scene_names_the_file_of_an_obstacle_that_cannot_be_read(tmp_path, obstacle, words):
    (tmp_path / "cut.npz").write_bytes(WHOLE[:-30])
    np.savez(tmp_path / "walk.npz", positions=FRAMES)
    np.savez(tmp_path / "flat.npz", positions=FRAMES.reshape(2, 12))
    (tmp_path / "broken.obj").write_text("v x 0 0\n")
    (tmp_path / "broken.ply").write_text("ply\n")
    with pytest.raises(InputError, match=words) as caught:
        load_scene(scene(tmp_path, f"{{kind: mesh, {obstacle}}}"))
    assert caught.value.mistakes[0].line == 6
