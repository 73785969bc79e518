"""Whatever a config holds, the command line answers with the place of the mistake, exit code 2, and no file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from harness.cli import app

SCENE = {
    "mesh": "{kind: grid}",
    "default_size": "4",
    "mass": "1",
    "time_step": "1/30",
    "frames": "2",
    "effects": "[{kind: springs, stretch: 100}, {kind: pins, at: [corners]}]",
}
SWEEP = {"scenes": "[good.yaml]", "sizes": "[4, 6]", "solvers": "[numba]"}


def text(base: dict[str, str], **changes: str | None) -> str:
    """A config whose lines are the keys of `base`, some of them changed, added or (None) left out."""
    return "".join(f"{key}: {value}\n" for key, value in {**base, **changes}.items() if value is not None)


def scene(**changes: str | None) -> str:
    return text(SCENE, **changes)


def sweep(**changes: str | None) -> str:
    return text(SWEEP, **changes)


BOMB = "a: &a [0,0,0,0,0,0,0,0,0,0]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdef", "bcdefg", strict=True)
)
NESTED_SCENE = "{kind: springs, stretch: " + "[" * 40 + "]" * 40 + "}"
LONG_LIST = "[" + ", ".join(map(str, range(2, 60))) + "]"

# what the file holds, what the message must name, and the line where there is one
SCENES: dict[str, tuple[str | bytes, str, int | None]] = {
    "empty file": ("", "is empty", None),
    "comments alone": ("# nothing\n", "is empty", None),
    "a list": ("- mesh\n- mass\n", "should hold a mapping", 1),
    "a word": ("mesh\n", "should hold a mapping", 1),
    "no keys of ours": ("colour: red\n", "neither a scene", None),
    "unfinished list": ("mesh: {kind: grid}\nframes: [1,\n", "is not YAML", 3),
    "tab as indent": ("mesh:\n\tkind: grid\n", "is not YAML", 2),
    "binary junk": (bytes(range(128, 256)), "UTF-8", 1),
    "latin-1": (b"mesh: {kind: grid}\ndescription: caf\xe9\n", "UTF-8", 2),
    "UTF-16": ("mesh: {kind: grid}\n".encode("utf-16"), "UTF-8", 1),
    "NUL": (b"mesh: {kind: grid}\nframes: \x00\n", "not allowed", 2),
    "escaped NUL in a file name": (scene(mesh=r'{kind: file, path: "a\0b.obj"}'), "mesh.path", 1),
    "lone surrogate": (scene(description=r'"\ud800"'), "description", 7),
    "two documents": (scene() + "---\n" + scene(), "single document", 7),
    "YAML 1.1 directive": ("%YAML 1.1\n---\n" + scene(), "directives", 1),
    "Python tag": (scene(mass="!!python/object/apply:os.system [touch pwned]"), "mass", 3),
    "own tag": (scene(mass="!mass 1"), "!mass", 3),
    "tag that does not fit": (scene(mass="!!int heavy"), "heavy", 3),
    "binary tag": (scene(mass="!!binary aGk="), "binary", 3),
    "alias bomb": (BOMB + scene(), "too large", None),
    "alias of itself": ("mesh: &m {kind: grid, inner: *m}\n", "too large", 1),
    "undefined alias": (scene(mass="*total"), "undefined alias", 3),
    "merge key": (scene(extra="{<<: {kind: grid}}"), "extra", 7),
    "deep nesting": ("mesh: " + "[" * 5000, "depth", 1),
    "nesting within the parser's reach": (scene(effects="[" * 31 + "]" * 31), "effects[0]", 6),
    "nested parameter": (scene(effects=f"[{NESTED_SCENE}]"), "depth", 6),
    "large file": ("# " + "x" * 2**18 + "\n" + scene(), "larger than", None),
    "duplicate key": (scene() + "mass: 2\n", "mass: duplicate key", 7),
    "duplicate key in a mesh": (scene(mesh="{kind: grid, width: 1, width: 2}"), "mesh.width: duplicate", 1),
    "list as key": (scene() + "? [a, b]\n: 1\n", "plain words", None),
    "unknown key": (scene(masss="1"), "did you mean 'mass'", 7),
    "unknown key in an effect": (scene(effects="[{kind: springs, stretch: 1, bnd: 1}]"), "'bend'", 6),
    "unknown key in the camera": (scene(camera="{azimut: 3}"), "camera.azimut", 7),
    "unknown mesh": (scene(mesh="{kind: gird}"), "did you mean 'grid'", 1),
    "unknown effect": (scene(effects="[{kind: springs, stretch: 1}, {kind: pin}]"), "effects[1].kind", 6),
    "mesh of no kind": (scene(mesh="{width: 1}"), "mesh", 1),
    "mesh as a word": (scene(mesh="grid"), "mesh", 1),
    "mesh of null": (scene(mesh="null"), "mesh", 1),
    "kind of a number": (scene(mesh="{kind: 3}"), "mesh.kind", 1),
    "effects as a mapping": (scene(effects="{kind: springs, stretch: 1}"), "effects", 6),
    "effect of null": (scene(effects="[null]"), "effects[0]", 6),
    "no frames": (scene(frames=None), "frames: is missing", None),
    "no time step": (scene(time_step=None), "time_step: is missing", None),
    "no mass": (scene(mass=None), "mass: is missing", None),
    "no size": (scene(default_size=None), "sizes: is missing", None),
    "mass of zero": (scene(mass="0"), "mass", 3),
    "negative mass": (scene(mass="-1"), "mass", 3),
    "mass of NaN": (scene(mass=".nan"), "mass", 3),
    "infinite mass": (scene(mass="-.inf"), "mass", 3),
    "overflowing mass": (scene(mass="1e999"), "mass", 3),
    "mass as a boolean": (scene(mass="true"), "mass", 3),
    "mass as text": (scene(mass="'1'"), "mass", 3),
    "mass with a unit": (scene(mass="1 kg"), "mass", 3),
    "mass as a list": (scene(mass="[1]"), "mass", 3),
    "time step of zero": (scene(time_step="0"), "time_step", 4),
    "time step by zero": (scene(time_step="1/0"), "time_step", 4),
    "time step of code": (scene(time_step="__import__('os').getcwd()"), "time_step", 4),
    "time step of a vast power": (scene(time_step="1e9999999999"), "time_step", 4),
    "time step that underflows": (scene(time_step="1e-300"), "time_step", 4),
    "frames of zero": (scene(frames="0"), "frames", 5),
    "frames of a fraction": (scene(frames="1.5"), "frames", 5),
    "frames as a boolean": (scene(frames="true"), "frames", 5),
    "frames beyond 64 bits": (scene(frames="9" * 30), "frames", 5),
    "frames of 5000 digits": (scene(frames="9" * 5000), "frames", 5),
    "frames of 5000 hexadecimal digits": (scene(frames="0x" + "f" * 5000), "frames", 5),
    "too many frames": (scene(frames="1e7"), "frames", 5),
    "velocity of two numbers": (scene(velocity="[0, 1]"), "velocity", 7),
    "velocity of four numbers": (scene(velocity="[0, 0, 0, 0]"), "velocity", 7),
    "velocity as a number": (scene(velocity="1"), "velocity", 7),
    "velocity of NaN": (scene(velocity="[0, .nan, 0]"), "velocity[1]", 7),
    "size of zero": (scene(default_size="0"), "default_size", 2),
    "size of 1e9": (scene(default_size="1e9"), "default_size", 2),
    "more vertices than memory": (scene(mesh="{kind: block}", default_size="5000"), "vertices", None),
    "negative stiffness": (scene(effects="[{kind: springs, stretch: -1}]"), "effects[0].stretch", 6),
    "stiffness as a boolean": (scene(effects="[{kind: springs, stretch: yes}]"), "effects[0].stretch", 6),
    "unknown rule": (scene(effects="[{kind: springs, stretch: 1, rule: magic}]"), "effects[0].rule", 6),
    "pins at no part": (scene(effects="[{kind: pins, at: [cornrs]}]"), "effects[0]", 6),
    "pins that pin nothing": (scene(effects="[{kind: pins}]"), "effects[0]", 6),
    "pins beyond the mesh": (scene(effects="[{kind: pins, indices: [16]}]"), "effects[0]", 6),
    "negative pin": (scene(effects="[{kind: pins, indices: [-1]}]"), "effects[0].indices[0]", 6),
    "pin weight of a word": (scene(effects="[{kind: pins, at: [top], weight: hard}]"), "'exact'", 6),
    "missing mesh file": (scene(mesh="{kind: file, path: none.obj}"), "mesh.path", 1),
    "folder as mesh file": (scene(mesh="{kind: file, path: folder}"), "mesh.path", 1),
    "mesh file beyond names": (scene(mesh="{kind: file, path: " + "x" * 5000 + "}"), "mesh.path", 1),
    "OBJ with a face beyond its vertices": (scene(mesh="{kind: file, path: beyond.obj}"), "beyond.obj", 4),
    "OBJ with a face of words": (scene(mesh="{kind: file, path: words.obj}"), "words.obj", 4),
    "OBJ with NaN": (scene(mesh="{kind: file, path: nan.obj}"), "nan.obj", 1),
    "empty OBJ": (scene(mesh="{kind: file, path: empty.obj}"), "empty.obj", None),
    "binary OBJ": (scene(mesh="{kind: file, path: junk.obj}"), "junk.obj", None),
}
SWEEPS: dict[str, tuple[str, str, int | None]] = {
    "no scenes": (sweep(scenes="[]"), "scenes", 1),
    "scenes as a word": (sweep(scenes="good.yaml"), "scenes", 1),
    "scene of null": (sweep(scenes="[null]"), "scenes[0]", 1),
    "scene inline": (sweep(scenes="[{mesh: {kind: grid}}]"), "scenes[0]", 1),
    "missing scene": (sweep(scenes="[none.yaml]"), "scenes[0]", 1),
    "sweep as scene": (sweep(scenes="[sweep.yaml]"), "is a sweep", None),
    "folder as scene": (sweep(scenes="[folder]"), "scenes[0]", 1),
    "loop of links as scene": (sweep(scenes="[loop.yaml]"), "scenes[0]", 1),
    "scene of an odd name": (sweep(scenes="['-rf .yaml']"), "-rf .yaml", None),
    "scene of dots": (sweep(scenes="['..']"), "scenes[0]", 1),
    "two scenes of one name": (sweep(scenes="[good.yaml, folder/good.yaml]"), "scenes[1]", 1),
    "size of 1": (sweep(sizes="[4, 1]"), "sizes[1]", 2),
    "negative size": (sweep(sizes="[-4]"), "sizes[0]", 2),
    "size of 1e9 in a sweep": (sweep(sizes="[4, 1e9]"), "sizes[1]", 2),
    "size as a boolean": (sweep(sizes="[true]"), "sizes[0]", 2),
    "sizes as a number": (sweep(sizes="8"), "sizes", 2),
    "no solvers": (sweep(solvers=None), "solvers: is missing", None),
    "empty solvers": (sweep(solvers="[]"), "solvers", 3),
    "unknown solver": (sweep(solvers="[numbat]"), "did you mean 'numba'", 3),
    "solver of a path": (sweep(solvers="['../../numba']"), "solvers[0]", 3),
    "solver that names code": (sweep(solvers="['os:system']"), "solvers[0]", 3),
    "unknown parameter": (sweep(solvers="[{name: numba, magic: 1}]"), "solvers[0].magic", 3),
    "unnamed solver": (sweep(solvers="[{precision: 1}]"), "solvers[0]", 3),
    "option outside options": (sweep(iterations="5"), "iterations", 4),
    "unknown option": (sweep(options="{iteration: 5}"), "did you mean 'iterations'", 4),
    "options as a list": (sweep(options="[5]"), "options", 4),
    "no iterations": (sweep(options="{iterations: 0}"), "options.iterations", 4),
    "empty list of iterations": (sweep(options="{iterations: []}"), "options.iterations", 4),
    "iterations as a boolean": (sweep(options="{iterations: [5, true]}"), "options.iterations[1]", 4),
    "tolerance of zero": (sweep(options="{tolerance: 0}"), "options.tolerance", 4),
    "tolerance of NaN": (sweep(options="{tolerance: [null, .nan]}"), "options.tolerance[1]", 4),
    "unknown first guess": (sweep(options="{first_guess: best}"), "options.first_guess", 4),
    "threads of a million": (sweep(options="{threads: 1e6}"), "options.threads", 4),
    "strain range of zero": (sweep(options="{strain_range: 0}"), "options.strain_range", 4),
    "record as text": (sweep(options="{record: 'no'}"), "options.record", 4),
    "convergence of frame zero": (sweep(options="{convergence_frames: [0]}"), "convergence_frames[0]", 4),
    "convergence beyond the end": (sweep(options="{convergence_frames: [1, 9]}"), "convergence_frames[1]", 4),
    "vast grid": (
        sweep(options=f"{{iterations: {LONG_LIST}, threads: {LONG_LIST}, rounds: {LONG_LIST}}}"),
        "at most 10000",
        4,
    ),
    "exclude of nothing": (sweep(exclude="[{size: 8}]"), "exclude[0]", 4),
    "exclude of all": (sweep(exclude="[{}]"), "leaves no run", 4),
    "exclude of an unknown solver": (sweep(exclude="[{solver: dense}]"), "exclude[0].solver", 4),
    "exclude as a mapping": (sweep(exclude="{size: 4}"), "exclude", 4),
    "include of no size": (sweep(include="[{iterations: 3}]"), "include[0].size", 4),
    "include of an unknown scene": (sweep(include="[{scene: goood, size: 4}]"), "did you mean 'good'", 4),
    "include of a vast size": (sweep(include="[{size: 10000}]"), "include[0].size[0]", 4),
}
QUAD = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OTHER_FILES = {
    "good.yaml": scene(),
    "-rf .yaml": scene(),
    "folder/good.yaml": scene(frames="3"),
    "sweep.yaml": sweep(),
    "beyond.obj": QUAD + "f 1 2 9\n",
    "words.obj": QUAD + "f one two three\n",
    "nan.obj": QUAD.replace("0 0 0", "nan 0 0") + "f 1 2 3\n",
    "empty.obj": "",
}
JSONS = {
    "empty JSON": ("", None),
    "JSON of a list": ("[]", None),
    "JSON of deep lists": ("[" * 100_000, None),
    "JSON without a mesh": ('{"k": 1, "b": []}', "obj"),
    "JSON of no such mesh": ('{"obj": "none.obj", "k": 1, "b": []}', "none.obj"),
    "JSON of NaN": ('{"obj": "quad.obj", "k": NaN, "b": []}', "k"),
    "JSON pinned beyond": ('{"obj": "quad.obj", "k": 1, "b": [4]}', "b"),
    "JSON pinned at zero": ('{"obj": "quad.obj", "k": 1, "b": [0]}', "b"),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of configs and meshes, sound and broken, and an empty folder of results."""
    for name in ("configs", "configs/folder", "results"):
        (tmp_path / name).mkdir()
    configs = tmp_path / "configs"
    for name, content in OTHER_FILES.items():
        (configs / name).write_text(content)
    (configs / "quad.obj").write_text(QUAD + "f 1 2 3\n")
    (configs / "junk.obj").write_bytes(bytes(range(128, 256)) * 8)
    (configs / "loop.yaml").symlink_to(configs / "loop.yaml")
    return tmp_path


def refusal(folder: Path, config: Path, *options: str, command: str = "run") -> list[str]:
    """The lines that the command line answers a config with, after it has exited with 2 and left no file."""
    before = sorted(folder.rglob("*"))
    arguments = [command, str(config), "--results", str(folder / "results"), *options]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2, (result.output, result.exception)
    assert "Traceback" not in result.output
    assert sorted(folder.rglob("*")) == before
    return result.output.strip().splitlines()


def one(lines: list[str], *needles: str) -> None:
    """There is one message, and it names all that is asked for."""
    assert len(lines) == 1, lines
    assert len(lines[0]) < 1500, "a message that fits a screen"
    for needle in needles:
        assert needle in lines[0]


def place(line: int | None) -> str:
    return f":{line}: " if line else ": "


@pytest.mark.parametrize("case", SCENES)
def test_a_hostile_scene_is_refused_with_its_place(folder: Path, case: str) -> None:
    content, needle, line = SCENES[case]
    config = folder / "configs" / "hostile.yaml"
    config.write_bytes(content if isinstance(content, bytes) else content.encode())
    lines = refusal(folder, config)
    one(lines, needle, str(folder / "configs"), place(line))


@pytest.mark.parametrize("case", SWEEPS)
def test_a_hostile_sweep_is_refused_with_its_place(folder: Path, case: str) -> None:
    content, needle, line = SWEEPS[case]
    config = folder / "configs" / "hostile.yaml"
    config.write_text(content)
    lines = refusal(folder, config, command="list")
    one(lines, needle, str(folder / "configs"), place(line))


@pytest.mark.parametrize("case", JSONS)
def test_a_hostile_assignment_is_refused(folder: Path, case: str) -> None:
    content, needle = JSONS[case]
    config = folder / "configs" / "hostile.json"
    config.write_text(content)
    one(refusal(folder, config), needle or "hostile.json")


@pytest.mark.parametrize("name", ["none.yaml", "folder", "loop.yaml", "none.json", "folder/none/none.yaml", "x" * 300])
def test_a_path_that_is_no_file_is_refused(folder: Path, name: str) -> None:
    one(refusal(folder, folder / "configs" / name), name)


@pytest.mark.parametrize(
    "name", ["-x.yaml", ".yaml", "a b.yaml", "a;b.yaml", "ü.yaml", "x" * 65 + ".yaml", "a\nb.yaml"]
)
@pytest.mark.parametrize("content", [scene(), sweep()], ids=["scene", "sweep"])
def test_a_file_whose_name_cannot_name_results_is_refused(folder: Path, name: str, content: str) -> None:
    config = folder / "configs" / name
    config.write_text(content)
    assert "name" in " ".join(refusal(folder, config))


def test_a_pipe_is_refused_instead_of_waited_for(folder: Path) -> None:
    os.mkfifo(folder / "configs" / "pipe.yaml")
    one(refusal(folder, folder / "configs" / "pipe.yaml"), "pipe.yaml", "is not a file")


@pytest.mark.parametrize(
    ("options", "needle"),
    [
        (["--solver", "numbat"], "did you mean 'numba'"),
        (["--size", "0"], "sizes[0]"),
        (["--iterations", "-1"], "options.iterations"),
        (["--tolerance", "nan"], "options.tolerance"),
        (["--first-guess", "best"], "options.first_guess"),
        (["--threads", "0"], "options.threads"),
    ],
    ids=str,
)
def test_a_hostile_option_is_refused(folder: Path, options: list[str], needle: str) -> None:
    one(refusal(folder, folder / "configs" / "good.yaml", *options), needle)


def test_options_that_a_sweep_sets_itself_are_refused(folder: Path) -> None:
    one(refusal(folder, folder / "configs" / "sweep.yaml", "--size", "8"), "sweep.yaml", "is a sweep")


def test_a_flood_of_mistakes_is_cut_short(folder: Path) -> None:
    config = folder / "configs" / "flood.yaml"
    config.write_text(scene() + "".join(f"key{i}: 0\n" for i in range(500)))
    lines = refusal(folder, config)
    assert len(lines) == 101
    assert "and more" in lines[-1]


def test_all_mistakes_of_a_sweep_and_its_scenes_come_at_once_in_the_order_of_their_lines(folder: Path) -> None:
    configs = folder / "configs"
    (configs / "bad.yaml").write_text(scene(mass="-1", frames="x", effects="[{kind: pins, at: [1]}]"))
    (configs / "worse.yaml").write_text(sweep(scenes="[bad.yaml, none.yaml]", sizes="[0]", solvers="[x, y]", z="1"))
    lines = refusal(folder, configs / "worse.yaml")
    keys = [line.split(": ")[2] for line in lines]
    assert keys == [
        *("mass", "frames", "effects[0].at[0]"),
        *("scenes[1]", "sizes[0]", "solvers[0].name", "solvers[1].name", "z"),
    ]
