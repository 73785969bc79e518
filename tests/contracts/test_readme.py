"""The examples of the pages are what they say: a sweep, a scene and an effect that work."""

import re
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh

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
