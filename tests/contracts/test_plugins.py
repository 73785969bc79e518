"""User code: solver, effect, mesh, integrator and report, installed or in a file next to the config."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.errors import InputError
from springbench.harness.experiments.provenance import collect_source_parts, compute_source_fingerprint
from springbench.harness.report.sweep_pictures import PictureJob, group_by_scene
from springbench.solvers.plugins.plugin_discovery import InvalidPluginName
from springbench.solvers.registry import SOLVER_TABLE

from tests.rare_cases import mark_rare_cases

ROOT = Path(__file__).resolve().parents[2]

CODE = '''"""One of each, by somebody else."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from springbench.harness.schema.base_model import ConfigModel
from springbench.harness.scenes.effects.effect_interface import EffectContribution, build_constant_force
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.solvers.model.integrators import IMPLICIT_EULER
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal

open(__file__ + ".was-run", "w").close()


@dataclass(frozen=True)
class Mine(SparseLocalGlobal):
    patience: int = 3


class Hum(ConfigModel):
    kind: Literal["hum"] = "hum"
    force: float

    def build_contribution(self, mesh, mass, time_step):
        return EffectContribution(forces=build_constant_force(np.full_like(mesh.rest_positions, self.force)))


class Cord(ChainMesh):
    kind: Literal["cord"] = "cord"


EULER = IMPLICIT_EULER


def tell(rows, folder):
    path = folder / "told.txt"
    path.write_text(f"{rows.num_rows} rows")
    return [path]
'''
ENTRIES = """
[springbench.solvers]
mine = somebodys:Mine
[springbench.effects]
hum = somebodys:Hum
[springbench.meshes]
cord = somebodys:Cord
[springbench.integrators]
euler = somebodys:EULER
[springbench.reports]
tell = somebodys:tell
"""
ABOUT = "somebodys-4.2.dist-info"
WHEEL = {
    "somebodys/__init__.py": CODE,
    f"{ABOUT}/METADATA": "Metadata-Version: 2.1\nName: somebodys\nVersion: 4.2\n",
    f"{ABOUT}/WHEEL": "Wheel-Version: 1.0\nGenerator: by hand\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    f"{ABOUT}/entry_points.txt": ENTRIES,
}
"""The content of a wheel: pip installs it without a build backend, and without a network."""
NAMES = {"mesh": "Cord", "effect": "Hum", "solver": "Mine", "integrator": "EULER", "report": "tell"}
ENTRY_POINTS = {"mesh": "cord", "effect": "hum", "solver": "mine", "integrator": "euler", "report": "tell"}
NAMING_FORMS = {
    "adjacent": {part: f"./mine.py:{name}" for part, name in NAMES.items()},
    "below": {part: f"./own/mine.py:{name}" for part, name in NAMES.items()},
    "module": {part: f"somebodys:{name}" for part, name in NAMES.items()},
    "entry-point": ENTRY_POINTS,
}


def configs(folder: Path, names: dict[str, str]) -> Path:
    """A sweep in a folder that names own code, in a scene and in itself."""
    (folder / "scene.yaml").write_text(
        f"mesh: {{kind: '{names['mesh']}', length: 2.0}}\nmass: 1.0\ntime_step: 1/30\nframes: 2\ndefault_size: 4\n"
        f"effects: [{{kind: springs, stretch: 200}}, {{kind: '{names['effect']}', force: 0.5}}, "
        "{kind: pins, parts: [ends]}]\n"
    )
    (folder / "sweep.yaml").write_text(
        f"scenes: [scene.yaml]\nsolvers: [{{name: '{names['solver']}', patience: 5}}]\nreports: ['{names['report']}']\n"
        f"options: {{integrator: '{names['integrator']}', rounds: 1, max_iterations: 3, pictures: false}}\n"
    )
    return folder / "sweep.yaml"


def springbench(folder: Path, *arguments: str, code: int = 0) -> str:
    """What a command says in a process of its own, to which the folder's `installed` are packages."""
    command = [sys.executable, "-m", "springbench", *arguments]
    path = os.pathsep.join([str(ROOT / ".src"), str(folder / "installed")])
    completed = subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
    )
    assert completed.returncode == code, completed.stdout + completed.stderr
    return completed.stdout + completed.stderr


def build_wheel(folder: Path) -> Path:
    """The package `somebodys`, ready to be installed."""
    wheel = folder / "somebodys-4.2-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, content in WHEEL.items():
            archive.writestr(name, content)
        archive.writestr(f"{ABOUT}/RECORD", "".join(f"{name},,\n" for name in [*WHEEL, f"{ABOUT}/RECORD"]))
    return wheel


@pytest.fixture(scope="module")
def installed_packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages in which the package `somebodys` was installed."""
    wheel, target = build_wheel(tmp_path_factory.mktemp("source")), tmp_path_factory.mktemp("installed")
    options = ["--quiet", "--no-deps", "--no-index", "--no-compile", "--target", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(wheel)], check=True)
    return target


@pytest.fixture
def plugin_folder(tmp_path: Path) -> Path:
    """A folder with own code in a file, and nothing installed."""
    (tmp_path / "own").mkdir()
    for path in (tmp_path / "mine.py", tmp_path / "own" / "mine.py"):
        path.write_text(CODE)
    return tmp_path


@pytest.mark.parametrize("way", mark_rare_cases(NAMING_FORMS, ["adjacent", "entry-point"]))
def test_a_sweep_runs_user_code_and_names_its_origin(way: str, plugin_folder: Path, installed_packages: Path):
    (plugin_folder / "installed").symlink_to(installed_packages)
    for mark in [*plugin_folder.rglob("*.was-run"), *installed_packages.rglob("*.was-run")]:
        mark.unlink()
    configs(plugin_folder, NAMING_FORMS[way])

    def has_run() -> bool:
        return any(next(folder.rglob("*.was-run"), None) for folder in (plugin_folder, installed_packages))

    assert "missing" in springbench(plugin_folder, "list", "sweep.yaml")
    assert not has_run(), "to list a config runs nothing that it names"
    springbench(plugin_folder, "run", "sweep.yaml")
    assert has_run()
    (rows,) = (plugin_folder / "results" / "sweep" / "rows").glob("*.parquet")
    row = pq.read_table(rows).to_pylist()[0]
    assert row["status"] == "ok", row["reason"]
    assert (row["solver"], row["integrator"]) == (NAMING_FORMS[way]["solver"], NAMING_FORMS[way]["integrator"])
    own = {name: (module, version) for name, module, version in json.loads(row["plugins"])}
    assert set(own) == {name for part, name in NAMING_FORMS[way].items() if part != "report"}
    for module, version in own.values():
        if way in ("adjacent", "below"):
            assert module == NAMING_FORMS[way]["solver"].partition(":")[0]
            assert len(version) == 12
        else:
            assert module == "somebodys"
            assert version.startswith("4.2+")
    assert (plugin_folder / "results" / "sweep" / "told.txt").read_text().endswith("rows")
    for mark in [*plugin_folder.rglob("*.was-run"), *installed_packages.rglob("*.was-run")]:
        mark.unlink()
    assert "done" in springbench(plugin_folder, "list", "sweep.yaml"), "the run has the same name, opened or not"
    if way in ("below", "module"):
        return  # their rows are like the others'
    springbench(plugin_folder, "schema")
    springbench(plugin_folder, "query", "select plugins from rows")
    springbench(plugin_folder, "report", "results/sweep")
    assert not has_run(), "rows are read without the code that they are of"


@pytest.mark.long
def test_a_fresh_environment_takes_both_packages_and_sweeps_with_them(tmp_path: Path):
    """This project and a user's, with all that they need, from the package index."""
    venv.create(tmp_path / "fresh", with_pip=True)
    bin, env = tmp_path / "fresh" / "bin", {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    expected = [str(ROOT), str(build_wheel(tmp_path))]
    subprocess.run([bin / "python", "-m", "pip", "install", "--quiet", *expected], check=True, env=env)
    configs(tmp_path, NAMING_FORMS["entry-point"])
    subprocess.run([bin / "springbench", "run", "sweep.yaml"], cwd=tmp_path, check=True, env=env)
    (rows,) = (tmp_path / "results" / "sweep" / "rows").glob("*.parquet")
    row = pq.read_table(rows).to_pylist()[0]
    assert (row["status"], row["solver"], row["integrator"]) == ("ok", "mine", "euler"), row["reason"]
    assert {module for _, module, _ in json.loads(row["plugins"])} == {"somebodys"}
    assert (tmp_path / "results" / "sweep" / "told.txt").exists()


def test_a_changed_file_is_another_run(plugin_folder: Path):
    sweep = configs(plugin_folder, NAMING_FORMS["adjacent"])
    springbench(plugin_folder, "run", "sweep.yaml")
    (plugin_folder / "mine.py").write_text(CODE.replace("patience: int = 3", "patience: int = 4"))
    assert "missing" in springbench(plugin_folder, "list", sweep.name)


def test_a_run_has_one_name_and_one_code_with_and_without_imported_plugins(plugin_folder: Path):
    sweep = configs(plugin_folder, NAMING_FORMS["adjacent"])
    closed, opened = (load_config(sweep, imports_code=opens).list_runs()[0] for opens in (False, True))
    assert closed.build_identity() == opened.build_identity()
    assert compute_source_fingerprint(collect_source_parts(closed)) == compute_source_fingerprint(
        collect_source_parts(opened)
    )
    shipped = load_config(ROOT / "configs" / "quickstart.yaml", imports_code=False).list_runs()[0]
    assert not shipped.find_plugins()


def test_two_of_one_solver_are_distinguished_by_what_only_one_of_them_states(plugin_folder: Path):
    sweep = configs(plugin_folder, NAMING_FORMS["adjacent"])
    sweep.write_text(sweep.read_text().replace("patience: 5}", "patience: 5}, './mine.py:Mine'"))
    (group,) = group_by_scene(
        [PictureJob(run, plugin_folder, plugin_folder) for run in load_config(sweep).list_runs()], plugin_folder
    )
    assert list(group.jobs_by_label) == ["./mine.py:Mine, patience 5", "./mine.py:Mine"]


def test_a_file_next_to_the_config_travels_between_processes(plugin_folder: Path):
    import pickle

    run = load_config(configs(plugin_folder, NAMING_FORMS["adjacent"])).list_runs()[0]
    (plugin_folder / "run.pickle").write_bytes(pickle.dumps(run))
    program = "import pickle; run = pickle.load(open('run.pickle', 'rb')); "
    program += "print(run.scene.load_plugins().effects[1], run.build_identity())"
    env = {**os.environ, "PYTHONPATH": str(ROOT / ".src")}
    completed = subprocess.run(
        [sys.executable, "-c", program], cwd=plugin_folder, env=env, capture_output=True, text=True
    )
    assert completed.stdout.split(" ", 2)[:2] == ["kind='hum'", "force=0.5"], completed.stderr
    assert completed.stdout.rstrip().endswith(run.build_identity())


RAISES = {
    "generate_mesh": ('"cord"\n', '"cord"\n\n    def generate_mesh(self, size):\n        return {}[3]\n'),
    "build_contribution": ("        return EffectContribution(", "        {}[3]; return EffectContribution("),
}


@pytest.mark.parametrize("method", RAISES)
def test_a_method_that_raises_is_named_with_its_line(method: str, plugin_folder: Path):
    (plugin_folder / "mine.py").write_text(CODE.replace(*RAISES[method]))
    with pytest.raises(InputError, match=rf"scene\.yaml:.*`{method}` raised KeyError: 3 \(mine\.py:\d+\)"):
        load_config(configs(plugin_folder, NAMING_FORMS["adjacent"]))


WEIGHTED_SOLVER = """
from dataclasses import dataclass, field

import numpy as np
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal


@dataclass(frozen=True)
class Weighted(SparseLocalGlobal):
    weights: np.ndarray = field(default_factory=lambda: np.ones(3))
"""


@pytest.mark.slow
def test_a_file_with_a_blank_in_its_name_and_a_field_that_is_an_array_are_verified(plugin_folder: Path):
    (plugin_folder / "my solver.py").write_text(WEIGHTED_SOLVER)
    sweep = configs(plugin_folder, NAMING_FORMS["adjacent"] | {"solver": "./my solver.py:Weighted"})
    sweep.write_text(sweep.read_text().replace(", patience: 5", "").replace("rounds: 1", "rounds: 1, verify: true"))
    springbench(plugin_folder, "run", "sweep.yaml")
    rows = [row for path in (plugin_folder / "results").rglob("*.parquet") for row in pq.read_table(path).to_pylist()]
    assert {(row["solver"], row["status"]) for row in rows} == {("./my solver.py:Weighted", "ok")}


REFUSED_NAMES = {
    "../mine.py:Mine": "expected",
    "/mine.py:Mine": "expected",
    "mine.py:Mine": "named from the config's folder on: ./file.py:Mine",
    "./../mine.py:Mine": "leaves the config's folder",
    "./own/../../mine.py:Mine": "leaves the config's folder",
    "./link.py:Mine": "leaves the config's folder",
    "./linked/mine.py:Mine": "leaves the config's folder",
    "./nothing.py:Mine": "there is no file",
    "./mine.py:": "expected",
    "nobodys:Mine": "which Python does not find",
    "springbench.solvers.nothing:Mine": "which Python does not find",
}


@pytest.mark.parametrize("name", REFUSED_NAMES)
def test_code_elsewhere_is_refused(name: str, plugin_folder: Path):
    inside = plugin_folder / "inside"
    (inside / "own").mkdir(parents=True)
    (inside / "mine.py").write_text(CODE)
    (inside / "link.py").symlink_to(plugin_folder / "mine.py")
    (inside / "linked").symlink_to(plugin_folder / "own")
    with pytest.raises(InvalidPluginName, match=r".") as caught:
        SOLVER_TABLE.resolve_name(name, inside)
    assert REFUSED_NAMES[name] in str(caught.value) or "from the config's folder on" in str(caught.value)


WRONG = {
    ("solver", "./mine.py:Nothing"): "./mine.py:Nothing cannot be loaded: ./mine.py has no Nothing",
    ("solver", "./mine.py:tell"): "./mine.py:tell is no solver; expected a frozen dataclass",
    ("effect", "./mine.py:Mine"): "./mine.py:Mine is no effect; expected a subclass",
    ("mesh", "./mine.py:Hum"): "./mine.py:Hum is no mesh; expected a subclass",
    ("integrator", "./mine.py:Mine"): "./mine.py:Mine is no integrator; expected an object",
    ("report", "./mine.py:EULER"): "./mine.py:EULER is no report; expected a function",
}


@pytest.mark.parametrize(("part", "name"), WRONG)
def test_the_target_of_a_name_is_checked_when_it_is_run(part: str, name: str, plugin_folder: Path):
    sweep = configs(plugin_folder, NAMING_FORMS["adjacent"] | {part: name})
    assert load_config(sweep, imports_code=False).list_runs()
    with pytest.raises(InputError) as caught:
        load_config(sweep)
    assert WRONG[part, name] in str(caught.value)


def test_wrong_parameters_of_own_code_are_reported_with_their_line(plugin_folder: Path):
    sweep = configs(plugin_folder, NAMING_FORMS["adjacent"])
    sweep.write_text(sweep.read_text().replace("patience: 5", "patience: soon"))
    with pytest.raises(InputError, match=r"sweep\.yaml:2: solvers\[0\]\.patience: got \"soon\"; should be"):
        load_config(sweep)
