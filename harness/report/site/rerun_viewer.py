"""Replay of recordings in a page by Rerun's web viewer.

The viewer and the recordings are stored as scripts that a page can load from files. The viewer is the one that the
installed `rerun` serves to browsers: a script and its WebAssembly module. Both are packed into one `viewer.js`, the
module as gzipped base64. A recording becomes a script of the same kind. `static/replay.js` loads them when a recording
is opened. The start of the viewer from a page is undocumented: the code that depends on it is in this module and in
that script, and is valid only for RERUN_VERSION.
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
from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import RunFailed
from springbench.harness.report.site.data_scripts import is_script_outdated

RERUN_VERSION = "0.41.0"
"""Version of rerun-sdk; a test fails if another one is installed, and then recordings have to be checked in it."""

VIEWER_SCRIPT = "viewer.js"
"""File name of the viewer's script, which is stored next to `replay.js`."""

_RERUN_SCRIPT, _RERUN_WASM = "re_viewer.js", "re_viewer_bg.wasm"
_HEADER_BYTES, _END_MESSAGE, _STORE_MESSAGE, _DATA_MESSAGE, _LAYOUT_MESSAGE = 12, 0, 1, 2, 3
"""Format of a recording: a header, then messages with 8 bytes each for kind and length, and their data.

The kinds are: end, store (of a recording or of a layout), data of a store, and completion of a layout.
"""

_SERVER_TIMEOUT = 30.0
"""Timeout of the viewer's server [s]."""

_SCRIPT_HEADER = "// Rerun's web viewer {version}, https://rerun.io, MIT or Apache-2.0; packed by springbench, {how}\n"
_ASSIGNMENT = "springbench.scriptContent = "
"""Statement by which a script passes its content; `replay.js` loads one script at a time."""

_VIEWER_TEMPLATE = """{{"wasm": {wasm}, "start": ((console, fetch) => {{
{script}
return wasm_bindgen;
}})(
  Object.assign(Object.create(window.console), {{debug() {{}}, info() {{}}, warn() {{}}}}),
  async () => new Response(null, {{status: 204}}),
)}}"""
"""Wrapper that suppresses the viewer's thousands of console messages and its usage reports to its authors."""


def rerun_binary() -> Path:
    """Return the path of Rerun's executable from the wheel.

    Its wrapper script would leave a process behind when killed.
    """
    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")


def write_viewer(folder: Path) -> Path:
    """Write `folder`/viewer.js, about 19 MB, unless it exists for the installed version; return its path.

    Raises:
        RunFailed: if the viewer is not installed or does not answer.
        WriteError: if the file cannot be written.
    """
    how = sha256((_ASSIGNMENT + _VIEWER_TEMPLATE).encode()).hexdigest()[:8]
    path, head = folder / VIEWER_SCRIPT, _SCRIPT_HEADER.format(version=version("rerun-sdk"), how=how)
    if is_script_outdated(path, [], head):
        script, wasm = _fetch_viewer_files()
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            value = _VIEWER_TEMPLATE.format(wasm=json.dumps(_encode_gzip(wasm)), script=script)
            partial.write_text(f"{head}{_ASSIGNMENT}{value};\n", encoding="utf-8")
    return path


def write_recording(recording: Path, script: Path, title: str) -> Path:
    """Write a recording (.rrd) as a script, and return the script's path.

    A script that is up to date is not written again.

    Args:
        recording: recording.
        script: target file.
        title: heading of the recording in the page.

    Raises:
        InputError: if the recording cannot be read.
        WriteError: if the file cannot be written.
    """
    if is_script_outdated(script, [recording], _ASSIGNMENT):
        script.parent.mkdir(parents=True, exist_ok=True)
        value = {"title": title, "rrd": _encode_gzip(move_layout_first(recording.read_bytes()))}
        with atomic_write(script) as partial:
            partial.write_text(f"{_ASSIGNMENT}{json.dumps(value)};\n", encoding="utf-8")
    return script


def move_layout_first(data: bytes) -> bytes:
    """Move the messages of a recording's layout before the others.

    The viewer then opens with it immediately. The index at the end of the file, up to half of its size, is omitted,
    because a stream needs no lookup.
    """
    messages, place = list[tuple[int, bytes]](), _HEADER_BYTES
    while place + 16 <= len(data):
        kind, length = struct.unpack_from("<QQ", data, place)
        if kind == _END_MESSAGE:
            break
        messages.append((kind, data[place : place + 16 + length]))
        place += 16 + length
    kinds = [kind for kind, _ in messages]
    if _LAYOUT_MESSAGE not in kinds:
        return data
    last = len(kinds) - kinds[::-1].index(_LAYOUT_MESSAGE)
    first = next((k for k in range(1, last) if kinds[k - 1] == _DATA_MESSAGE and kinds[k] == _STORE_MESSAGE), 0)
    order = [*messages[first:last], *messages[:first], *messages[last:]]
    return data[:_HEADER_BYTES] + b"".join(message for _, message in order)


def _encode_gzip(data: bytes) -> str:
    return b64encode(gzip.compress(data, 6, mtime=0)).decode()


def _fetch_viewer_files() -> tuple[str, bytes]:
    """Fetch the viewer's script and WebAssembly module from its own server.

    The server listens only on the loopback interface.
    """
    with _run_viewer_server() as address:
        script, wasm = (_fetch_with_retries(f"{address}/{name}") for name in (_RERUN_SCRIPT, _RERUN_WASM))
    return script.decode().replace("arg0.fetch(", "fetch("), wasm  # the wrapper's, not the window's


@contextmanager
def _run_viewer_server() -> Generator[str]:
    if not rerun_binary().is_file():
        raise RunFailed(f"the viewer is not installed: {rerun_binary()} is missing; install rerun-sdk again")
    port, other = _find_free_ports(2)
    command = [
        rerun_binary(),
        "--serve-web",
        "--bind",
        "127.0.0.1",
        "--port",
        str(other),
        "--web-viewer-port",
        str(port),
    ]
    none, own = subprocess.DEVNULL, os.environ | {"TELEMETRY_ENABLED": "false"}
    server = subprocess.Popen(command, env=own, stdin=none, stdout=none, stderr=none)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


def _fetch_with_retries(url: str) -> bytes:
    """Fetch the content of an address, with retries.

    Raises:
        RunFailed: if there is no answer in time.
    """
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    until = time.monotonic() + _SERVER_TIMEOUT
    while True:
        try:
            with direct.open(url, timeout=_SERVER_TIMEOUT) as answer:
                return answer.read()
        except (urllib.error.URLError, ConnectionError) as error:
            if time.monotonic() > until:
                raise RunFailed(f"the viewer does not answer at {url}: {error}; --no-viewer omits it") from None
            time.sleep(0.05)


def _find_free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports
