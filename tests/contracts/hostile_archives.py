"""Archives and folders of results as a stranger may send them: damaged, made up, or made to harm."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.archive.publication import publish_results
from springbench.harness.results import parquet_rows

from tests.contracts.hostile import BOMB, scene
from tests.synthetic_run_rows import build_dummy_rows

SWEEP = "scenes: [cloth.yaml]\nsizes: [4]\nsolvers: [sparse]\n"
ROWS = "results/sweep/rows/a.parquet"
CONFIG = "configs/sweep/sweep.yaml"

Content = dict[str, bytes]


def good_results(folder: Path) -> None:
    """Results of a sweep whose rows have the id of the run that its config requests, and its config."""
    (folder / "cloth.yaml").write_text(scene())
    (folder / "sweep.yaml").write_text(SWEEP)
    (folder / "results" / "sweep" / "rows").mkdir(parents=True)
    (folder / "results" / "sweep" / ".config").write_text("../../sweep.yaml\n")
    (run,) = load_config(folder / "sweep.yaml").list_runs()
    made = [row | {"run_id": run.compute_run_id("00000000"), "solver": "sparse"} for row in build_dummy_rows(0)]
    parquet_rows.write_rows(folder / "results" / "sweep" / "rows" / "a.parquet", made)


def good_archive(folder: Path) -> Content:
    """The files of an archive of such results."""
    good_results(folder)
    publish_results(folder / "results", folder / "good.zip", lambda line: None)
    with zipfile.ZipFile(folder / "good.zip") as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def build_archive(content: Content) -> bytes:
    """An archive with valid checksums, but where the content has its own."""
    sums = "".join(f"{sha256(data).hexdigest()}  {name}\n" for name, data in sorted(content.items()))
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in ({"SHA256SUMS": sums.encode(errors="surrogateescape")} | content).items():
            packed.writestr(name, data)
    return file.getvalue()


def table(**columns: Any) -> bytes:
    """A file of rows with these columns."""
    file = io.BytesIO()
    pq.write_table(pa.table(columns), file)
    return file.getvalue()


def rewrite_columns(**given: Any) -> Callable[[Content], None]:
    """Columns with other values in all rows; a pyarrow array has a type of its own."""

    def change(content: Content) -> None:
        read = pq.read_table(io.BytesIO(content[ROWS]))
        for name, value in given.items():
            array = (
                value if isinstance(value, pa.Array) else pa.array([value] * len(read), read.schema.field(name).type)
            )
            at = read.schema.get_field_index(name)
            read = read.append_column(name, array) if at < 0 else read.set_column(at, name, array)
        file = io.BytesIO()
        pq.write_table(read, file)
        content[ROWS] = file.getvalue()

    return change


def put(name: str, data: bytes | str | Callable[[], bytes]) -> Callable[[Content], None]:
    def change(content: Content) -> None:
        content[name] = data.encode() if isinstance(data, str) else data if isinstance(data, bytes) else data()

    return change


def without(*names: str) -> Callable[[Content], None]:
    def change(content: Content) -> None:
        for name in names:
            del content[name]

    return change


def repeated_text(count: int, length: int) -> bytes:
    """A few kB that claim as many texts of that length."""
    texts = pa.DictionaryArray.from_arrays(pa.array([0] * count, pa.int32()), pa.array(["x" * length]))
    file = io.BytesIO()
    columns = {
        "run_id": texts,
        "status": texts,
        "started_at": texts,
        "source_fingerprint": texts,
        "scene": texts,
        "solver": texts,
    }
    pq.write_table(pa.table(columns), file, compression="zstd", store_schema=False)
    return file.getvalue()


def packed_rows(**columns: Any) -> Callable[[Content], None]:
    def change(content: Content) -> None:
        del content[ROWS]
        content["results/sweep/rows.parquet"] = table(**columns)

    return change


def cut(name: str, length: int) -> Callable[[Content], None]:
    return lambda content: content.update({name: content[name][:length]})


ONE = {"run_id": ["a"], "status": ["ok"], "started_at": ["2026"], "phase": ["step"]}

CHANGES: dict[str, Callable[[Content], None]] = {
    "no sums": lambda content: None,  # see `archive`
    "sums that are no UTF-8": put("SHA256SUMS", b"\xff\xfe  \xff\n"),
    "sums of one word": put("SHA256SUMS", "abc"),
    "sums of NUL": put("SHA256SUMS", b"\0" * 1000),
    "sums of files elsewhere": put("SHA256SUMS", f"{'0' * 64}  ../../../../etc/passwd\n{'0' * 64}  /etc/passwd\n"),
    "sums of 100,000 files": put("SHA256SUMS", "".join(f"{'0' * 64}  {k}\n" for k in range(100_000))),
    "sums that are a folder": put("SHA256SUMS/a", "a"),
    "no rows": without(ROWS),
    "rows of no bytes": put(ROWS, b""),
    "rows of text": put(ROWS, "run_id,status\n"),
    "rows that are cut": cut(ROWS, 1000),
    "rows of the end alone": put(ROWS, b"\xff\xff\xff\x7fPAR1"),
    "rows without columns": put(ROWS, table()),
    "rows without rows": put(ROWS, table(run_id=pa.array([], pa.string()), status=pa.array([], pa.string()))),
    "rows without a phase": put(ROWS, table(run_id=["a"], status=["ok"])),
    "columns of one name": put(ROWS, table(**ONE)),  # see `doubled`
    "a phase that is null": rewrite_columns(phase=None),
    "a frame that is null": rewrite_columns(frame=None),
    "a frame of 2**62": rewrite_columns(frame=2**62),
    "a negative frame": rewrite_columns(frame=-5),
    "a round that is null": rewrite_columns(round=None),
    "a round of 2**62": rewrite_columns(round=2**62),
    "a status that is null": rewrite_columns(status=None),
    "a status of its own": rewrite_columns(status="splendid"),
    "a run id that is null": rewrite_columns(run_id=None),
    "a run id that leads elsewhere": rewrite_columns(run_id="../../../../../elsewhere/evil"),
    "a run id that is a number": rewrite_columns(run_id=pa.array([1.5, 2.5])),
    "a size that is a text": rewrite_columns(size=pa.array(["big", "small"])),
    "a size below zero": rewrite_columns(size=-1),
    "a size of 2**62": rewrite_columns(size=2**62),
    "seconds that are words": rewrite_columns(seconds=pa.array(["soon", "late"])),
    "seconds that are null": rewrite_columns(seconds=None),
    "seconds of NaN": rewrite_columns(seconds=float("nan")),
    "seconds below zero": rewrite_columns(seconds=-1.0),
    "no digest": rewrite_columns(positions_digest=None),
    "a machine that is null": rewrite_columns(machine_id=None),
    "threads of 2**62": rewrite_columns(threads=2**62),
    "a time step of NaN": rewrite_columns(time_step=float("nan")),
    "a tolerance of infinity": rewrite_columns(residual_rtol=float("inf")),
    "a requested error of -1": rewrite_columns(error_requested=-1.0),
    "parameters that are no JSON": rewrite_columns(parameters="{" * 10_000),
    "a solver of markup": rewrite_columns(solver="[bold]\x1b[2J<script>\n"),
    "a scene of 10 MB": rewrite_columns(scene="x" * 10_000_000),
    "a nested column": rewrite_columns(extra=pa.array([{"a": [1, 2], "b": {"c": 3}}, None])),
    "a column called file": rewrite_columns(file=pa.array(["a", "b"])),
    "a column called file_index": rewrite_columns(file_index=pa.array([7, 8])),
    "a column called SIZE": rewrite_columns(SIZE=pa.array([7, 8])),
    "a column without a name": rewrite_columns(**{"": pa.array([7, 8])}),
    "2,000 columns": rewrite_columns(**{f"c{k}": pa.array([k, k]) for k in range(2_000)}),
    "200 GB of texts": put(ROWS, lambda: repeated_text(200_000, 1_000_000)),
    "2 million rows of a kB": put(ROWS, lambda: repeated_text(1_900_000, 1_000)),
    "3 million rows": put(ROWS, lambda: table(run_id=pa.nulls(3_000_000, pa.string()))),
    "packed rows without names": packed_rows(**ONE),
    "packed rows with names that are null": packed_rows(**ONE, file=pa.array([None], pa.string())),
    "packed rows with numbers for names": packed_rows(**ONE, file=[3]),
    "packed rows with lists for names": packed_rows(**ONE, file=[["a"]]),
    "packed rows that lead elsewhere": packed_rows(**ONE, file=["../../../../../../elsewhere/evil"]),
    "packed rows of an empty name": packed_rows(**ONE, file=[""]),
    "packed rows that are text": put("results/sweep/rows.parquet", "text"),
    "no config": without(CONFIG),
    "a config that is empty": put(CONFIG, ""),
    "a config of aliases": put(CONFIG, BOMB),
    "a config of brackets": put(CONFIG, "[" * 100_000),
    "a config of Python": put(CONFIG, "!!python/object/apply:os.system [touch evil]"),
    "a config of a device": put(CONFIG, "scenes: [/dev/zero]\nsizes: [4]\nsolvers: [sparse]\n"),
    "a config of 1e6 runs": put(CONFIG, SWEEP + f"options: {{max_iterations: {list(range(1, 1001))}}}\n"),
    "a config of code that hangs": put(CONFIG, SWEEP.replace("sparse", "./hang.py:Solver")),
    "no scene": without("configs/sweep/cloth.yaml"),
    "a way to no config": put("results/sweep/.config", ""),
    "a way of NUL": put("results/sweep/.config", b"\0"),
    "a way of 100 kB": put("results/sweep/.config", "../" * 30_000),
    "a way elsewhere": put("results/sweep/.config", "../../../../../../../../../etc/passwd"),
    "a way to a device": put("results/sweep/.config", "/dev/zero"),
    "a way that is no UTF-8": put("results/sweep/.config", b"\xff"),
    "a way to a folder": put("results/sweep/.config", ".."),
}


def archive(name: str, good: Content, path: Path) -> None:
    """The archive of this name, from the files of a good one."""
    content = dict(good)
    del content["SHA256SUMS"]
    CHANGES[name](content)
    packed = build_archive(content)
    if name == "columns of one name":
        file = io.BytesIO()
        pq.write_table(pa.Table.from_arrays([pa.array(["a"])] * 2, names=["run_id", "run_id"]), file)
        packed = build_archive(content | {ROWS: file.getvalue()})
    if name == "no sums":
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as into:
            for inside, data in content.items():
                into.writestr(inside, data)
        packed = file.getvalue()
    path.write_bytes(packed)


def entries(*named: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An archive of these files, whatever they are called."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as packed:
        for name, data in named:
            packed.writestr(zipfile.ZipInfo(name) if method == zipfile.ZIP_STORED else name, data)
    return file.getvalue()


def link_entry() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as packed:
        info = zipfile.ZipInfo("SHA256SUMS")
        info.external_attr = 0o120777 << 16
        packed.writestr(info, "/etc/passwd")
    return file.getvalue()


def overlapping(copies: int = 500) -> bytes:
    """Many entries that are all the same bytes."""
    whole = entries(("a", b"\0" * 10_000_000))
    end = whole.rindex(b"PK\x05\x06")
    at = struct.unpack("<I", whole[end + 16 : end + 20])[0]
    directory = b"".join(whole[at:end].replace(b"\0\0a", b"\0\0a", 1) for _ in range(copies))
    tail = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, copies, copies, len(directory), at, 0)
    return whole[:at] + directory + tail


def patch_bytes(data: bytes, old: bytes, new: bytes) -> bytes:
    assert old in data
    return data.replace(old, new)


CENTRAL = b"PK\x01\x02\x14\x03\x14\0"
"""How an entry of the directory begins, before its flags."""

RAW: dict[str, Callable[[], bytes]] = {
    "empty": lambda: b"",
    "text": lambda: b"results",
    "the end of an archive alone": lambda: b"PK\x05\x06" + 18 * b"\0",
    "a directory that is cut": lambda: entries(("a", b"b"))[:-30],
    "zeros that swell": lambda: entries(("SHA256SUMS", b"\0" * 300_000_000)),
    "entries that overlap": overlapping,
    "by lzma": lambda: entries(("SHA256SUMS", b"a"), method=zipfile.ZIP_LZMA),
    "by bzip2": lambda: entries(("SHA256SUMS", b"a"), method=zipfile.ZIP_BZIP2),
    "encrypted": lambda: patch_bytes(
        entries(("SHA256SUMS", b"a")), b"PK\x01\x02\x14\x03\x14\0\0\0", b"PK\x01\x02\x14\x03\x14\0\x01\0"
    ),
    "names that lead elsewhere": lambda: entries(("../../evil", b"a"), ("/evil", b"a"), ("SHA256SUMS", b"")),
    "a name of 5,000 characters": lambda: entries(("a" * 5_000, b"a")),
    "a deep name": lambda: entries(("a/" * 3_000 + "b", b"a")),
    "a file and a folder of one name": lambda: entries(("a", b"a"), ("a/b", b"a")),
    "a folder and a file of one name": lambda: entries(("a/b", b"a"), ("a", b"a")),
    "a link for the sums": link_entry,
    "a damaged sum": lambda: patch_bytes(
        entries(("SHA256SUMS", b"hello"), method=zipfile.ZIP_STORED), b"hello", b"jello"
    ),
    "a damaged stream": lambda: patch_bytes(
        entries(("SHA256SUMS", b"hello" * 9)), b"\xcbH\xcd\xc9\xc9", b"\xff\xff\xff\xff\xff"
    ),
    "a name that is no UTF-8": lambda: patch_bytes(
        entries(("é" * 3, b"a")), "ééé".encode(), b"\xff\xfe\xff\xfe\xff\xfe"
    ),
    "a name twice": lambda: entries(("SHA256SUMS", b""), ("SHA256SUMS", b"b")),
    "210,000 files": lambda: entries(*((str(k), b"") for k in range(210_000)), method=zipfile.ZIP_STORED),
}


def replace_path(place: str, make: Callable[[Path], object]) -> Callable[[Path], None]:
    """Something else in the place of a file or folder of the results."""

    def change(folder: Path) -> None:
        path = folder / "results" / place
        if path.is_dir() and not path.is_symlink():
            path.rename(folder / "away")
        else:
            path.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        make(path)

    return change


def link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def odd_unit(name: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        place = os.fsencode(folder / "results" / "sweep" / "rows")
        os.rename(os.path.join(place, b"a.parquet"), os.path.join(place, name))

    return change


def rename_results(name: bytes) -> Callable[[Path], None]:
    return lambda folder: os.rename(folder / "results" / "sweep", os.path.join(os.fsencode(folder / "results"), name))


def other_type(folder: Path) -> None:
    unit = folder / "results" / "sweep" / "rows" / "b.parquet"
    unit.write_bytes(table(run_id=["b"], status=["ok"], started_at=["2026"], size=["large"]))


FOLDERS: dict[str, Callable[[Path], None]] = {
    "rows that are a file": replace_path("sweep/rows", Path.touch),
    "rows that are a pipe": replace_path("sweep/rows", os.mkfifo),
    "rows that are a link to a device": replace_path("sweep/rows", link_to("/dev/zero")),
    "rows that link to themselves": replace_path("sweep/rows", link_to("rows")),
    "a unit that is a pipe": replace_path("sweep/rows/a.parquet", os.mkfifo),
    "a unit that is a folder": replace_path("sweep/rows/a.parquet", Path.mkdir),
    "a unit that is a device": replace_path("sweep/rows/a.parquet", link_to("/dev/zero")),
    "a unit that is nothing": replace_path("sweep/rows/a.parquet", link_to("none")),
    "packed rows that are a pipe": replace_path("sweep/rows.parquet", os.mkfifo),
    "packed rows that are a folder": replace_path("sweep/rows.parquet", Path.mkdir),
    "packed rows that are a device": replace_path("sweep/rows.parquet", link_to("/dev/zero")),
    "a lock that is a pipe": replace_path("sweep/.lock", os.mkfifo),
    "a lock that is a link": replace_path("sweep/.lock", link_to("../../sweep.yaml")),
    "a lock that is a folder": replace_path("sweep/.lock", Path.mkdir),
    "a way that is a pipe": replace_path("sweep/.config", os.mkfifo),
    "a way that is a device": replace_path("sweep/.config", link_to("/dev/zero")),
    "a way that is a folder": replace_path("sweep/.config", Path.mkdir),
    "recordings that are a pipe": replace_path("sweep/recordings", os.mkfifo),
    "a recording that is a pipe": replace_path("sweep/recordings/a.rrd", os.mkfifo),
    "a recording that is a device": replace_path("sweep/recordings/a.rrd", link_to("/dev/zero")),
    "a picture that is a link": replace_path("sweep/pictures/a.png", link_to("/etc/passwd")),
    "a folder called as a column": rename_results(b"size=64"),
    "a folder called as a pattern": rename_results(b"[a]*?"),
    "a folder that is no UTF-8": rename_results(b"\xff\xfe"),
    "a folder of two lines": rename_results(b"a\nb"),
    "a unit called as a pattern": odd_unit(b"[*]?.parquet"),
    "a unit that is no UTF-8": odd_unit(b"\xff.parquet"),
    "a unit of two lines": odd_unit(b"a\nb.parquet"),
    "a unit without a name": odd_unit(b".parquet"),
    "a column of another type": other_type,
}
