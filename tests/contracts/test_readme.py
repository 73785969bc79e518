"""The examples of the pages are what they say: a sweep, a scene and an effect that work."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import GATES, load_config, load_scene, read_config
from springbench.harness.experiments.regression.gates_file import GatesFile
from springbench.harness.experiments.regression.program_pair import require_agreement
from springbench.harness.experiments.regression.solver_pair import prepare_solver_pair
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import build_scene

ROOT = Path(__file__).resolve().parents[2]


def example(page: str, language: str) -> str:
    """The first fenced block of a language in a page of `configs/howto`."""
    text = (ROOT / "configs" / "howto" / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)[0]


def test_the_sweep_of_the_page_is_a_sweep(tmp_path: Path):
    (tmp_path / "scenes").symlink_to(ROOT / "configs" / "scenes")
    (tmp_path / "sweep.yaml").write_text(example("write-a-sweep.md", "yaml"))
    runs = load_config(tmp_path / "sweep.yaml").list_runs()
    # two scenes, three sizes, three solvers, two limits, two guesses; less dense at 64; and one more
    assert len(runs) == 2 * 3 * 3 * 2 * 2 - 2 * 2 * 2 + 1


def test_the_scene_of_the_page_is_a_scene(tmp_path: Path):
    (tmp_path / "scene.yaml").write_text(example("write-a-scene.md", "yaml"))
    (run,) = load_config(tmp_path / "scene.yaml").list_runs()
    assert (run.size, run.frames, run.solver.name) == (48, 90, "hybrid")
    assert [type(effect).__name__ for effect in run.scene.effects] == [
        "SpringsEffect",
        "GravityEffect",
        "WindEffect",
        "PinsEffect",
    ]


def test_the_net_of_the_page_is_a_net_from_a_file(tmp_path: Path):
    page = (ROOT / "configs" / "howto" / "networks-and-fabrics.md").read_text(encoding="utf-8")
    section = page.partition("## A net from a file\n")[2].partition("\n## ")[0]
    scene, net, cables = re.findall(r"```\w+\n(.*?)```", section, re.DOTALL)
    for name, content in {"scene.yaml": scene, "net.obj": net, "cables.csv": cables}.items():
        (tmp_path / name).write_text(content)
    made = build_scene(load_scene(tmp_path / "scene.yaml"), 0)
    strain = np.array([50.0, 60.0]) / 2000.0  # tensions over EA
    assert made.all_springs.rest_length == pytest.approx(1.0 / (1.0 + strain))
    assert made.all_springs.stiffness == pytest.approx(2000.0 * (1.0 + strain))
    assert made.system.free_vertices.tolist() == [1]


@pytest.mark.slow
def test_the_gates_of_the_page_compare_equal_solutions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    tutorial = (ROOT / "configs" / "tutorials" / "3-your-solver-and-ours.md").read_text(encoding="utf-8")
    names = {"mine.py": r"'{3}(.*?)'{3}", "cloth.yaml": r'"{3}\n(mesh.*?)"{3}'}
    for name, pattern in names.items():
        (content,) = re.findall(pattern, tutorial, re.DOTALL)
        Path(name).write_text(content)
    Path("test_gates.py").write_text(example("gates-in-ci.md", "python"))
    command = [sys.executable, "-m", "pytest", "-q", "--benchmark-disable", "-p", "no:cacheprovider", "test_gates.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, "2 passed" in done.stdout) == (0, True), done.stdout
    Path("gates.yaml").write_text(example("gates-in-ci.md", "yaml"))
    _, document = read_config(Path("gates.yaml"), GATES)
    gates = document.validate_data(GatesFile, document.data)
    assert gates is not None
    (gate,) = gates.gates
    options = {"max_iterations": gate.max_iterations, "rtol": gate.rtol}
    candidate, baseline = prepare_solver_pair(Path(gate.scene), gate.solver, gate.baseline, size=None, **options)
    require_agreement(candidate(), baseline(), gate.agreement_rtol)


def test_the_effect_of_the_page_is_an_effect():
    names: dict = {"__name__": "linear_drag"}
    exec(compile(example("your-own-effect.md", "python"), "<page>", "exec"), names)
    assert len(example("your-own-effect.md", "python").splitlines()) <= 40
    mesh = ChainMesh().build_mesh(3)
    (drag,) = names["LinearDrag"](coefficient=2.0).build_contribution(mesh, np.ones(3), 0.1).forces
    v = np.arange(9.0).reshape(3, 3)
    assert drag(mesh.rest_positions, v, 0.0) == pytest.approx(-2.0 * v)


def test_the_solver_of_the_page_is_the_one_of_the_examples() -> None:
    names: dict = {"__name__": "own_solver"}
    exec(compile(example("your-own-solver.md", "python"), "<page>", "exec"), names)
    p, before, correction = np.ones((2, 3)), np.zeros((2, 3)), np.full((2, 3), 0.5)
    assert names["HeavyBall"](momentum=0.25).next_iterate(p, before, correction) == pytest.approx(0.75 * p)
