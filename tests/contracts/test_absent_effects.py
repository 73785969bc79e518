"""An effect that a scene does not list is not there: not imported, not in Q, not in a single bit of the motion."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.scene_builder import build_scene
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.effect_scenes import AIR_DRAG_EFFECT, BENDING_EFFECT, DASHPOT_EFFECT, STRAIN_LIMIT_EFFECT, build_effect_cloth

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "configs" / "scenes" / "hanging-cloth.yaml"
LISTED_EFFECTS = {"springs", "gravity", "ether-drag", "pins"}
ABSENT_EFFECTS = sorted(set(EFFECT_CLASSES) - LISTED_EFFECTS)

ENERGIES = {
    "bending": [
        "springbench.solvers.model.energies.bending_energy",
        "springbench.solvers.model.energies.quadratic_energy",
    ],
    "contact": [
        "springbench.solvers.contact.half_space.half_space_potential",
        "springbench.solvers.contact.half_space.separating_planes",
        "springbench.harness.scenes.primitive_obstacles",
    ],
    "self-contact": [
        "springbench.solvers.contact.contact_potential",
        "springbench.solvers.contact.potentials.barrier",
        "springbench.harness.scenes.edge_triangle_intersections",
    ],
    "surface-contact": ["springbench.solvers.contact.obstacle_mesh", "springbench.harness.scenes.surface_obstacles"],
    "sewing": ["springbench.solvers.model.energies.sewing_energy"],
    "strain-limits": ["springbench.solvers.model.energies.strain_limit_energy"],
    "dashpots": ["springbench.solvers.model.energies.dashpot_energy"],
    "air-drag": ["springbench.solvers.model.energies.quadratic_energy"],
    "ether-drag": ["springbench.solvers.model.energies.quadratic_energy"],
    "rayleigh": [
        "springbench.solvers.model.energies.quadratic_energy",
        "springbench.solvers.model.energies.dashpot_energy",
    ],
    "attachments": ["springbench.solvers.model.energies.attachment_energy"],
    "gas": ["springbench.solvers.model.energies.gas_energy"],
}
"""The energies that an effect brings along."""

PROBE = """
import hashlib, json, sys
from pathlib import Path

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name in {hidden}:
            raise ImportError(name + " is hidden")

sys.meta_path.insert(0, Hidden())
import springbench
if {load}:
    from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
    from springbench.solvers.registry import load_target
    for target in EFFECT_CLASSES.values():
        load_target(target)
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import StopRule
made = build_scene(load_scene(Path({scene!r})), 10)
steps = simulate_scene(made, prepare(made, SparseLocalGlobal()), StopRule(10), initial_guess="previous", frames=5)
digests = [hashlib.sha256(step.positions.tobytes()).hexdigest() for step in steps]
print(json.dumps({{"modules": sorted(sys.modules), "digests": digests}}))
"""


def probe(*, hidden: Sequence[str] = (), load: bool = False) -> dict:
    """What a fresh process imports and computes, with modules hidden, or with all effects loaded first."""
    script = PROBE.format(hidden=hidden, load=load, scene=str(SCENE))
    completed = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    return json.loads(completed.stdout)


def modules(effects: list[str]) -> list[str]:
    own = [EFFECT_CLASSES[kind].partition(":")[0] for kind in effects]
    return own + [module for kind in effects for module in ENERGIES.get(kind, [])]


def list_absent_modules() -> list[str]:
    """What no listed effect has."""
    return sorted(set(modules(ABSENT_EFFECTS)) - set(modules(sorted(LISTED_EFFECTS))))


@pytest.fixture(scope="module")
def plain() -> dict:
    return probe()


def test_checking_and_running_a_scene_imports_only_the_effects_that_it_names(plain):
    assert set(modules(sorted(LISTED_EFFECTS))) <= set(plain["modules"])
    assert not set(list_absent_modules()) & set(plain["modules"])


def test_the_motion_has_the_same_bits_with_the_other_effects_hidden_or_loaded(plain):
    assert probe(hidden=list_absent_modules())["digests"] == plain["digests"]
    loaded = probe(load=True)
    assert set(modules(ABSENT_EFFECTS)) <= set(loaded["modules"])
    assert loaded["digests"] == plain["digests"]


def test_every_energy_module_belongs_to_an_effect():
    # No effect has an augmented Lagrangian: AVBD uses it for exact lengths. Some networks have cables.
    always = {"edge_energy", "element_energies", "spring_energy", "augmented_lagrangian", "__init__"}
    always |= {"tension_only_energy"}
    files = {path.stem for path in (ROOT / "solvers" / "model" / "energies").glob("*.py")} - always
    owned = {name.rpartition(".")[2] for bound in ENERGIES.values() for name in bound if "energies" in name}
    assert owned == files


def test_the_system_matrix_has_no_entry_from_an_absent_effect():
    bare, dashpots, limits, drag, bend = (
        assemble_system_matrix(made.system, [*made.system.energies])  # pyright: ignore[reportArgumentType]
        for made in (
            build_effect_cloth(),
            build_effect_cloth(DASHPOT_EFFECT),
            build_effect_cloth(STRAIN_LIMIT_EFFECT),
            build_effect_cloth(AIR_DRAG_EFFECT),
            build_effect_cloth(BENDING_EFFECT),
        )
    )
    # These lie where springs and masses lie, so Q has other numbers and no more of them; bending reaches further.
    assert bare.nnz == dashpots.nnz == limits.nnz == drag.nnz < bend.nnz
    made = build_effect_cloth()
    springs, n = made.all_springs, len(made.mesh.rest_positions)
    assert bare.nnz == n + 2 * len(np.unique(np.sort(springs.edges, axis=1), axis=0))


def test_a_scene_has_nothing_but_what_it_lists():
    made = build_scene(load_scene(SCENE), 6)
    assert [type(energy).__name__ for energy in made.system.energies] == ["Springs"]
    assert (made.varying_forces, made.pin_motions, len(made.velocity_filters)) == ((), (), 1)
    assert made.compute_pin_targets(3.0) is made.pin_targets
