"""Recordings replayed in a page: Rerun's own web viewer, and recordings, as scripts that a page may load from files.

The viewer is the one that the installed `rerun` serves to browsers: a script and its WebAssembly. Both go into one
`viewer.js`, the latter gzipped in base64. A recording becomes a script of the same kind. `static/replay.js` takes them
when somebody asks for a recording. How the viewer is started from a page is not documented: all that knows it is here
and there, and it holds for VERSION alone.
"""

from __future__ import annotations

import gzip
import json
import os
import socket
import struct
import subprocess
import time
import urllib.error
import urllib.request
from base64 import b64encode
from collections.abc import Generator
from contextlib import contextmanager
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

import rerun_cli  # pyright: ignore[reportMissingTypeStubs]

from harness.base.errors import RunFailed
from harness.base.files import replacing

VERSION = "0.41.0"
"""Of rerun-sdk; a test says when another one is installed, and then opens recordings in it."""

VIEWER = "viewer.js"
"""The name of the viewer's script, which lies beside `replay.js`."""

_SCRIPT, _WASM = "re_viewer.js", "re_viewer_bg.wasm"
_HEADER, _END, _STORE, _DATA, _LAID_OUT = 12, 0, 1, 2, 3
"""A recording is a header and messages, each a kind and a length of 8 bytes, then its bytes: the end, a store of a
recording's or a layout's, a part of one, and that a layout is complete."""

_PATIENCE = 30.0
"""Seconds that the viewer's server may take to answer."""

_HEAD = "// Rerun's web viewer {version}, https://rerun.io, MIT or Apache-2.0; packed by springbench, {how}\n"
_TAKEN = "springbench.taken = {};\n"
"""How a script hands over what it brings; `replay.js` asks for one at a time."""

_QUIET = """{{"wasm": {wasm}, "start": ((console, fetch) => {{
{script}
return wasm_bindgen;
}})(
  Object.assign(Object.create(window.console), {{debug() {{}}, info() {{}}, warn() {{}}}}),
  async () => new Response(null, {{status: 204}}),
)}}"""
"""The viewer tells the console of all that it does, thousands of lines, and its makers of its use: here neither."""


def binary() -> Path:
    """Rerun's own program, which the wheel brings; its script is a wrapper that outlives a kill of it."""
    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")


def write_viewer(folder: Path) -> Path:
    """Write `folder`/viewer.js, some 19 MB, where it is not there for the installed version; returns its path.

    Raises RunFailed where the viewer is not installed or does not answer, CannotWrite.
    """
    how = sha256(_QUIET.encode()).hexdigest()[:8]
    path, head = folder / VIEWER, _HEAD.format(version=version("rerun-sdk"), how=how)
    if not _begins(path, head):
        script, wasm = _served()
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            value = _QUIET.format(wasm=json.dumps(_packed(wasm)), script=script)
            partial.write_text(head + _TAKEN.format(value), encoding="utf-8")
    return path


def write_recording(recording: Path, script: Path, title: str) -> Path:
    """Write a recording (.rrd) as a script, where that is not there or older; returns the script's path.

    title: what stands above it in the page. Raises InputError where the recording cannot be read, CannotWrite.
    """
    made = recording.stat().st_mtime_ns
    if not script.is_file() or script.stat().st_mtime_ns < made:
        script.parent.mkdir(parents=True, exist_ok=True)
        value = {"title": title, "rrd": _packed(layout_first(recording.read_bytes()))}
        with replacing(script) as partial:
            partial.write_text(_TAKEN.format(json.dumps(value)), encoding="utf-8")
    return script


def layout_first(data: bytes) -> bytes:
    """A recording's messages with those of its layout before the others, so that the viewer opens with it at once.

    The index at the file's end, which may be half of it, is left out: nothing is looked for in a stream.
    """
    messages, place = list[tuple[int, bytes]](), _HEADER
    while place + 16 <= len(data):
        kind, length = struct.unpack_from("<QQ", data, place)
        if kind == _END:
            break
        messages.append((kind, data[place : place + 16 + length]))
        place += 16 + length
    kinds = [kind for kind, _ in messages]
    if _LAID_OUT not in kinds:
        return data
    last = len(kinds) - kinds[::-1].index(_LAID_OUT)
    first = next((k for k in range(1, last) if kinds[k - 1] == _DATA and kinds[k] == _STORE), 0)
    order = [*messages[first:last], *messages[:first], *messages[last:]]
    return data[:_HEADER] + b"".join(message for _, message in order)


def _begins(path: Path, head: str) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(head.encode())) == head.encode()


def _packed(data: bytes) -> str:
    return b64encode(gzip.compress(data, 6, mtime=0)).decode()


def _served() -> tuple[str, bytes]:
    """The viewer's script and its WebAssembly, as it serves them itself, on the loopback alone."""
    with _serving() as address:
        script, wasm = (_fetched(f"{address}/{name}") for name in (_SCRIPT, _WASM))
    return script.decode().replace("arg0.fetch(", "fetch("), wasm  # that of the window, else


@contextmanager
def _serving() -> Generator[str]:
    if not binary().is_file():
        raise RunFailed(f"the viewer is not installed: {binary()} is missing; install rerun-sdk again")
    port, other = _free_ports(2)
    command = [binary(), "--serve-web", "--bind", "127.0.0.1", "--port", str(other), "--web-viewer-port", str(port)]
    none, own = subprocess.DEVNULL, os.environ | {"TELEMETRY_ENABLED": "false"}
    server = subprocess.Popen(command, env=own, stdin=none, stdout=none, stderr=none)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


def _fetched(url: str) -> bytes:
    """What is served at an address, as soon as there is an answer. Raises RunFailed where there is none in time."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    until = time.monotonic() + _PATIENCE
    while True:
        try:
            with direct.open(url, timeout=_PATIENCE) as answer:
                return answer.read()
        except (urllib.error.URLError, ConnectionError) as error:
            if time.monotonic() > until:
                raise RunFailed(
                    f"the viewer does not answer at {url}: {error}; --without-viewer leaves it out"
                ) from None
            time.sleep(0.05)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports
