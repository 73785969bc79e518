"""The examples of the pages are what they say: a sweep, a scene and an effect that work."""

import re
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh

ROOT = Path(__file__).resolve().parents[2]


def example(page: str, section: str, language: str) -> str:
    """The fenced block of a language in the section of a page whose heading begins so."""
    (text,) = re.findall(rf"^## {section}.*?\n(.*?)(?=^## |\Z)", (ROOT / page).read_text(), re.M | re.S)
    (block,) = re.findall(rf"```{language}\n(.*?)```", text, re.S)
    return block


def test_the_sweep_of_the_readme_is_a_sweep(tmp_path: Path):
    (tmp_path / "scenes").symlink_to(ROOT / "configs" / "scenes")
    (tmp_path / "sweep.yaml").write_text(example("configs/README.md", "Writing a sweep", "yaml"))
    runs = load_config(tmp_path / "sweep.yaml").list_runs()
    # two scenes, three sizes, three solvers, two limits, two guesses; less dense at 64; and one more
    assert len(runs) == 2 * 3 * 3 * 2 * 2 - 2 * 2 * 2 + 1


def test_the_scene_of_the_readme_is_a_scene(tmp_path: Path):
    (tmp_path / "scene.yaml").write_text(example("configs/README.md", "Writing a scene", "yaml"))
    (run,) = load_config(tmp_path / "scene.yaml").list_runs()
    assert (run.size, run.frames, run.solver.name) == (48, 90, "hybrid")
    assert [type(effect).__name__ for effect in run.scene.effects] == [
        "SpringsEffect",
        "GravityEffect",
        "WindEffect",
        "PinsEffect",
    ]


def test_the_effect_of_the_readme_is_an_effect():
    names: dict = {"__name__": "linear_drag"}
    exec(compile(example("harness/README.md", "Adding an effect", "python"), "<README.md>", "exec"), names)
    assert len(example("harness/README.md", "Adding an effect", "python").splitlines()) <= 40
    mesh = ChainMesh().build_mesh(3)
    (drag,) = names["LinearDrag"](coefficient=2.0).build_contribution(mesh, np.ones(3), 0.1).forces
    v = np.arange(9.0).reshape(3, 3)
    assert drag(mesh.rest_positions, v, 0.0) == pytest.approx(-2.0 * v)


PAGES = [page for page in ROOT.glob("**/*.md") if not {".venv", ".pytest_cache", "node_modules"} & set(page.parts)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere(page: Path):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), target
