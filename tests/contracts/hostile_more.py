"""More hostile input: JSON scenes, stored benchmarks, queries, command lines, and results.

Each case: what the files contain or the command line is, the exit code, and what the answer must name.
"""

from __future__ import annotations

import json
from typing import Any

from tests.contracts.hostile import scene, sweep


def json_scene(**changes: Any) -> str:
    return json.dumps({"obj": "quad.obj", "k": 1.0, "b": [1], **changes})


SCENES_JSON: dict[str, str | bytes] = {
    "5 MB of pins": json_scene(b=[1] * 1_700_000),
    "4 MB of words for pins": json_scene(b=["x"] * 600_000),
    "4 MB of lists for pins": '{"obj": "quad.obj", "k": 1, "b": [' + "[]," * 1_000_000 + "[]]}",
    "4 MB of objects": '{"obj": "quad.obj", "k": 1, "b": [' + "{}," * 1_000_000 + "{}]}",
    "4 MB of nested lists": '{"b": ' + "[" * 2_000_000 + "]" * 2_000_000 + "}",
    "a key of 4 MB": '{"' + "k" * 4_000_000 + '": 1}',
    "100000 keys": "{" + ", ".join(f'"k{i}": 0' for i in range(100_000)) + "}",
    "a stiffness of 5000 digits": '{"obj": "quad.obj", "k": ' + "9" * 5000 + ', "b": []}',
    "a stiffness of 1e999": '{"obj": "quad.obj", "k": 1e999, "b": []}',
    "a stiffness that is true": json_scene(k=True),
    "a negative stiffness": json_scene(k=-1),
    "a mass of zero": json_scene(m=0),
    "a pin that is a fraction": json_scene(b=[1.5]),
    "a pin of 30 digits": json_scene(b=[10**30]),
    "a pin twice": json_scene(b=[1, 1]),
    "a mesh that is a number": json_scene(obj=7),
    "a mesh that is empty": json_scene(obj=""),
    "a mesh that is a folder": json_scene(obj="."),
    "a mesh that is a device": json_scene(obj="/dev/zero"),
    "a mesh with NUL": json_scene(obj="a\0b.obj"),
    "a mesh of a lone surrogate": '{"obj": "\\ud800.obj", "k": 1, "b": []}',
    "a mesh of 5000 letters": json_scene(obj="x" * 5000),
    "a key twice": '{"obj": "quad.obj", "obj": "quad.obj", "k": 1, "b": []}',
    "UTF-16": json_scene().encode("utf-16"),
    "no text": bytes(range(128, 256)),
    "a number": "7",
    "null": "null",
}


def build_benchmark_file(**changes: Any) -> dict[str, Any]:
    one = {"fullname": "a::b", "stats": {"min": 0.01}, "extra_info": {"ratio": {"median": 1, "low": 0.9, "high": 1.1}}}
    return {"machine_info": {"cpu": {}}, "benchmarks": [one | changes], "version": "5"}


GATES: dict[str, str | bytes] = {
    "empty": "",
    "a list": "[]",
    "null": "null",
    "no text": bytes(range(128, 256)),
    "no machine": json.dumps({"benchmarks": build_benchmark_file()["benchmarks"]}),
    "a machine that is a list": json.dumps(build_benchmark_file() | {"machine_info": []}),
    "benchmarks that are a mapping": json.dumps(build_benchmark_file() | {"benchmarks": {}}),
    "a name that is a number": json.dumps(build_benchmark_file(fullname=3)),
    "a minimum of 1e999": json.dumps(build_benchmark_file()).replace("0.01", "1e999"),
    "a minimum of NaN": json.dumps(build_benchmark_file(stats={"min": float("nan")})),
    "a minimum of zero": json.dumps(build_benchmark_file(stats={"min": 0})),
    "a minimum of words": json.dumps(build_benchmark_file(stats={"min": "fast"})),
    "stats that are null": json.dumps(build_benchmark_file(stats=None)),
    "a median of 1e999": json.dumps(build_benchmark_file()).replace('"median": 1', '"median": 1e999'),
    "an interval of 1e999": json.dumps(build_benchmark_file()).replace("1.1", "1e999"),
    "an interval upside down": json.dumps(build_benchmark_file()).replace("0.9", "9.9"),
    "a ratio that is a list": json.dumps(build_benchmark_file(extra_info={"ratio": [1, 1, 1]})),
    "a ratio of infinity": json.dumps(build_benchmark_file()).replace('"median": 1', '"median": Infinity'),
    "deep lists": "[" * 100_000,
    "40 MB": " " * 40_000_000 + json.dumps(build_benchmark_file()),
    "cut": json.dumps(build_benchmark_file())[:-20],
}

QUERIES: dict[str, str] = {
    "a text of 3 GB": "SELECT repeat('x', 3000000000)",
    "a list of 1e10": "SELECT range(10000000000)",
    "all rows in one text": "SELECT string_agg(range::VARCHAR, ',') FROM range(300000000)",
    "2 GB of texts in a list": "SELECT array_agg(x) FROM (SELECT repeat('x', 1000000) x FROM range(2000))",
    "a table of 1e9 rows": "CREATE TABLE t AS SELECT * FROM range(1000000000)",
    "a sort of 1e9 rows": "SELECT * FROM range(1000000000) ORDER BY random()",
    "nothing": "",
    "a comment": "-- nothing",
    "a semicolon": ";",
    "no SQL": "please",
    "half a statement": "SELECT (",
    "no such table": "SELECT * FROM secrets",
    "no such column": "SELECT secret FROM rows",
    "a file": "SELECT * FROM '/etc/hostname'",
    "a file as text": "SELECT * FROM read_text('/etc/hostname')",
    "a file as CSV": "SELECT * FROM read_csv('/etc/passwd')",
    "files": "SELECT * FROM glob('/etc/*')",
    "a copy to a file": "COPY rows TO 'stolen.csv'",
    "a copy to a device": "COPY rows TO '/dev/full' (FORMAT csv)",
    "an export": "EXPORT DATABASE 'stolen'",
    "a database in a file": "ATTACH 'stolen.db' AS x",
    "an extension": "INSTALL httpfs",
    "an extension from a file": "LOAD './x.duckdb_extension'",
    "a setting": "SET memory_limit = '100GB'",
    "a locked setting": "SET lock_configuration = false",
    "threads": "SET threads = 1000",
    "access": "SET enable_external_access = true",
    "100000 brackets": "SELECT " + "(" * 100_000,
    "a sum of 20000": "SELECT " + "+".join(["1"] * 20_000),
    "a number out of range": "SELECT 1e400::DOUBLE::INTEGER",
}

COMMANDS: dict[str, tuple[list[str], int, str]] = {
    "threads of 5000 digits": (["run", "good.yaml", "--threads", "9" * 5000], 2, "threads"),
    "threads of words": (["run", "good.yaml", "--threads", "all"], 2, "threads"),
    "threads in other digits": (["run", "good.yaml", "--threads", "٣"], 2, "threads"),
    "a size of 30 digits": (["run", "good.yaml", "--size", "9" * 30], 2, "size"),
    "frames of 5000 digits": (["run", "good.yaml", "--frames", "9" * 5000], 2, "frames"),
    "a time step of infinity": (["run", "good.yaml", "--time-step", "inf"], 2, "time_step"),
    "a negative time step": (["run", "good.yaml", "--time-step", "-1"], 2, "time_step"),
    "an integrator of another program": (["run", "good.yaml", "--integrator", "rk4"], 2, "integrator"),
    "positions in a folder": (["run", "good.yaml", "--positions", "folder.npz"], 2, "--positions"),
    "positions in no folder": (["run", "good.yaml", "--positions", "none/p.npz"], 2, "--positions"),
    "positions of another kind": (["run", "good.yaml", "--positions", "p.txt"], 2, "--positions"),
    "positions in a device": (["run", "good.yaml", "--positions", "device.npz"], 2, "--positions"),
    "positions of two runs": (["run", "sweep.yaml", "--positions", "p.npz"], 2, "--positions"),
    "a budget below zero": (["roofline", "sweep.yaml", "--budget", "-1"], 2, "--budget"),
    "a budget of zero": (["roofline", "sweep.yaml", "--budget", "0"], 2, "--budget"),
    "a budget of NaN": (["roofline", "sweep.yaml", "--budget", "nan"], 2, "--budget"),
    "a budget of infinity": (["roofline", "sweep.yaml", "--budget", "inf"], 2, "--budget"),
    "the speed of a scene": (["roofline", "good.yaml"], 2, "good.yaml"),
    "the accuracy of a sweep": (["accuracy", "sweep.yaml"], 2, "sweep.yaml"),
    "the accuracy of a device": (["accuracy", "/dev/zero"], 2, "/dev/zero"),
    "a run of a device": (["run", "/dev/zero"], 2, "/dev/zero"),
    "a gallery of a sweep": (["gallery", "sweep.yaml"], 2, "sweep.yaml"),
    "a gallery of a device": (["gallery", "/dev/zero"], 2, "/dev/zero"),
    "a gallery into no folder": (["gallery", "good.yaml", "-o", "none/sheet.png"], 2, "--output"),
    "a gallery into a folder": (["gallery", "good.yaml", "-o", "."], 2, "--output"),
    "a gallery of another kind": (["gallery", "good.yaml", "-o", "sheet.tiff"], 2, "--output"),
    "an ablation of a sweep": (["ablate", "sweep.yaml"], 2, "sweep.yaml"),
    "an ablation of no rounds": (["ablate", "good.yaml", "--rounds", "0"], 2, "rounds"),
    "a recommendation to NaN": (["recommend", "good.yaml", "--error", "nan"], 2, "--error"),
    "a recommendation to nothing": (["recommend", "good.yaml", "--error", "0"], 2, "--error"),
    "a recommendation for ever": (["recommend", "good.yaml", "--error", ".1", "--t-end", "inf"], 2, "--t-end"),
    "a recommendation of a sweep": (["recommend", "sweep.yaml", "--error", ".1"], 2, "sweep.yaml"),
    "a report on nothing": (["report", "results/none"], 2, "results/none"),
    "a report on a file": (["report", "good.yaml"], 2, "good.yaml"),
    "a gate on devices": (["regress", "/dev/zero", "--baseline", "/dev/zero"], 2, "/dev/zero"),
    "a gate on folders": (["regress", ".", "--baseline", "."], 2, "no rows"),
    "a gate on a pipe": (["regress", "pipe", "--baseline", "pipe"], 2, "pipe"),
    "a query without rows": (["query", "SELECT 1"], 2, "no rows"),
    "a query in no time": (["query", "SELECT 1", "--cpu-limit", "0"], 2, "--cpu-limit"),
    "a query in NaN seconds": (["query", "SELECT 1", "--cpu-limit", "nan"], 2, "--cpu-limit"),
    "an inspection of a device": (["inspect", "/dev/zero"], 2, "/dev/zero"),
    "an inspection of a pipe": (["inspect", "pipe"], 2, "pipe"),
    "an inspection of a config": (["inspect", "good.yaml"], 2, "good.yaml"),
    "an inspection of frame 5000 digits": (
        ["inspect", "x.rrd", "--frame", "9" * 5000, "--export", "x.ply"],
        2,
        "frame",
    ),
    "a view of a config": (["view", "good.yaml"], 2, "good.yaml"),
    "a command of no such name": (["conquer"], 2, "conquer"),
    "an option of no such name": (["run", "good.yaml", "--rm-rf"], 2, "--rm-rf"),
    "an option without a value": (["run", "good.yaml", "--size"], 2, "--size"),
    "results in a file": (["run", "good.yaml", "--results", "good.yaml"], 2, "good.yaml"),
    "results in a device": (["run", "good.yaml", "--results", "/dev/null"], 2, "/dev/null"),
    "results that nobody may write": (["run", "good.yaml", "--results", "/proc/self"], 2, "/proc"),
    "results of a name too long": (["run", "good.yaml", "--results", "x" * 300], 2, "too long"),
    "results of NUL": (["run", "good.yaml", "--results", "a\0b"], 2, "NUL"),
    "a config of NUL": (["run", "a\0b.yaml"], 2, "NUL"),
    "a mesh of NUL": (["run", "good.yaml", "--solver", "a\0b"], 2, "solver"),
    "the list of a sweep in a file": (["list", "sweep.yaml", "--results", "good.yaml"], 0, "missing"),
}

SPHERE = "{kind: sphere, center: [0, -1, 0], radius: 0.5, motion: {key_frames: [%s]}}"
BALL = "{kind: sphere, center: [0.5, -2, 0.5], radius: 0.1}"
MOVES = "motion: {key_frames: [{time: 0}, {time: 1, offset: [0, 6, 0]}]}"
RISING = f"{{kind: sphere, center: [0.5, -3, 0.5], radius: 0.1, {MOVES}}}"
CONTACT = "[{kind: springs, stretch: 100}, {kind: contact, obstacles: [%s]}]"
KEYS = ", ".join(f"{{time: {i}}}" for i in range(10_001))
MOVING_PINS = "{kind: pins, parts: [corners], motion: {key_frames: [{time: 0}, {time: 1, offset: [0, -4, 0]}]}}"
PRESS = (
    "{kind: plane, point: [0, -1, 0]}, {kind: plane, point: [0, 1, 0], normal: [0, -1, 0], motion: {key_frames: %s}}"
)

SCENES: dict[str, tuple[str, str]] = {
    "gravity twice": (scene(effects="[{kind: gravity}, {kind: springs, stretch: 1}, {kind: gravity}]"), "effects[2]"),
    "10001 keys": (scene(effects=CONTACT % (SPHERE % KEYS)), "key_frames"),
    "keys of one time": (scene(effects=CONTACT % (SPHERE % "{time: 0}, {time: 0}")), "rise"),
    "keys at infinity": (scene(effects=CONTACT % (SPHERE % "{time: .inf}")), "time"),
    "an obstacle of no direction": (scene(effects=CONTACT % "{kind: plane, normal: [0, 0, 0]}"), "direction"),
    "an obstacle of no kind": (scene(effects=CONTACT % "{shape: plane}"), "with a `kind`, one of"),
    "an obstacle of an unknown kind": (scene(effects=CONTACT % "{kind: plan}"), "did you mean 'plane'"),
    "an obstacle of no radius": (scene(effects=CONTACT % "{kind: sphere, radius: 0}"), "radius"),
    "a box inside out": (scene(effects=CONTACT % "{kind: box, low: [1, 1, 1], high: [0, 0, 0]}"), "high"),
    "a press that closes": (
        scene(effects=CONTACT % (PRESS % "[{time: 0}, {time: 1, offset: [0, -2, 0]}]")),
        "leave no room",
    ),
    "a press that closes and opens": (
        scene(
            effects=CONTACT % (PRESS % "[{time: 0}, {time: 1, offset: [0, -3, 0]}, {time: 2}], interpolation: smooth")
        ),
        "leave no room",
    ),
    "pins that go through a ball": (
        scene(effects=f"[{MOVING_PINS}, {{kind: contact, obstacles: [{BALL}]}}]"),
        "pins fix vertex",
    ),
    "a ball that goes through pins": (
        scene(effects=f"[{{kind: pins, parts: [corners]}}, {{kind: contact, obstacles: [{RISING}]}}]"),
        "pins fix vertex",
    ),
    "a part in Unicode": (scene(effects="[{kind: pins, parts: ['tоp']}]"), "parts"),
    "an index of 1e18": (scene(effects="[{kind: pins, indices: [1000000000000000000]}]"), "indices"),
    "every 1e18th": (scene(effects="[{kind: pins, stride: 0}]"), "stride"),
    "a stiffness of 1e400": (scene(effects="[{kind: springs, stretch: 1e400}]"), "stretch"),
    "gas in a sheet": (scene(effects="[{kind: gas, pressure: 1}]"), "gas"),
    "a thickness of 1e9": (
        scene(effects="[{kind: springs, stretch: 1}, {kind: contact, obstacles: [{kind: plane}], min_distance: 1e9}]"),
        "min_distance",
    ),
    "a spin of NaN": (scene(start="{kind: rest, angular_velocity: [0, .nan, 0]}"), "angular_velocity"),
    "a start of another kind": (scene(start="{kind: exploded}"), "start"),
    "a merge of what is not there": (scene(start="{kind: merged, vertices: [0, 99]}"), "start.vertices"),
}

SOLVERS: dict[str, tuple[str, str]] = {
    "pairs of -3": (sweep(solvers="[{name: lbfgs, history_size: -3}]"), "history_size"),
    "pairs of 0": (sweep(solvers="[{name: anderson, history_size: 0}]"), "history_size"),
    "pairs of 1e9": (sweep(solvers="[{name: lbfgs, history_size: 1000000000}]"), "history_size"),
    "pairs of a fraction": (sweep(solvers="[{name: lbfgs, history_size: 2.5}]"), "history_size"),
    "a radius of 1": (sweep(solvers="[{name: vbd, spectral_radius: 1}]"), "spectral_radius"),
    "a precision of words": (sweep(solvers="[{name: numba, precision: best}]"), "precision"),
}
