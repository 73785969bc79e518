"""Starts other than rest: where the vertices are, how they move, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.harness.scenes.mesh.star_mesh import StarMesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.start_positions import AnyStart
from springbench.harness.simulation.time_loop import build_initial_state

REST = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 4.0, 0.0], [0.0, 4.0, 8.0]])
MEAN = [1.0, 2.0, 2.0]


def positions(**keys) -> np.ndarray:
    made = TypeAdapter(AnyStart).validate_python(keys)
    before = REST.copy()
    p = made.compute_positions(REST)
    np.testing.assert_array_equal(REST, before)
    return p


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"kind": "rest"}, REST),
        ({"kind": "collapsed"}, [MEAN] * 4),
        ({"kind": "flattened", "axes": "y"}, REST * [1, 0, 1] + [0, 2, 0]),
        ({"kind": "flattened", "axes": ["y", "z"]}, REST * [1, 0, 0] + [0, 2, 2]),
        ({"kind": "scaled", "factors": [-1, 1, 1]}, REST * [-1, 1, 1] + [2, 0, 0]),
        ({"kind": "scaled", "factors": [3, 3, 3]}, 3 * REST - 2 * np.array(MEAN)),
        ({"kind": "merged", "vertices": [1, 3]}, [REST[0], REST[1], REST[2], REST[1]]),
    ],
    ids=lambda value: value["kind"] if isinstance(value, dict) else "",
)
def test_a_start_is_that_of_its_kind(keys, expected):
    np.testing.assert_array_equal(positions(**keys), expected)


def test_random_starts_fill_their_cube_and_follow_their_seed():
    p = positions(kind="random", side_length=0.5)
    assert np.abs(p - MEAN).max() <= 0.25
    np.testing.assert_array_equal(p, positions(kind="random", side_length=0.5))
    assert np.abs(p - positions(kind="random", side_length=0.5, seed=1)).max() > 0.01


def test_perturbed_starts_are_displaced_by_about_the_stated_distance():
    away = positions(kind="perturbed", standard_deviation=1e-3, seed=2) - REST
    assert 2e-4 < away.std() < 5e-3  # twelve normal numbers of deviation 1e-3


def test_a_spin_turns_about_the_mean_and_carries_no_momentum():
    made = TypeAdapter(AnyStart).validate_python({"kind": "rest", "angular_velocity": [0, 0, 2]})
    v = made.compute_spin_velocity(REST)
    np.testing.assert_allclose(v.sum(axis=0), 0.0, atol=1e-15)
    np.testing.assert_array_equal(v[0], np.cross([0, 0, 2], REST[0] - MEAN))


SCENE = "mesh: {{kind: grid}}\nmass: 1\ntime_step: 0.1\nframes: 2\ndefault_size: 3\nvelocity: [1, 0, 0]\nstart: {}\n"


def write_scene(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text)
    return path


def test_a_scene_starts_as_stated_and_its_digest_includes_the_start(tmp_path: Path):
    spec = load_scene(write_scene(tmp_path, SCENE.format("{kind: collapsed, angular_velocity: [0, 5, 0]}")))
    begun = build_initial_state(build_scene(spec, 3)).motion
    np.testing.assert_allclose(
        begun.positions, np.tile(GridMesh().build_mesh(3).rest_positions.mean(axis=0), (9, 1)), atol=1e-15
    )
    np.testing.assert_allclose(begun.velocity, np.tile([1.0, 0.0, 0.0], (9, 1)), atol=1e-14)  # no arm, no spin
    other = load_scene(write_scene(tmp_path, SCENE.format("{kind: rest}")))
    plain = load_scene(write_scene(tmp_path, SCENE.format("null")))
    assert len({spec.scene_digest, other.scene_digest, plain.scene_digest}) == 3


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        (SCENE.format("{kind: colapsed}"), "start"),
        (SCENE.format("{kind: scaled, factors: [1, .nan, 1]}"), "start.factors[1]"),
        (SCENE.format("{kind: random, side_length: -1}"), "start.side"),
        (SCENE.format("{kind: merged, vertices: [1, 1]}"), "twice"),
        (SCENE.format("{kind: merged, vertices: [1, 9]}"), "the mesh has the vertices 0 to 8"),
    ],
)
def test_an_invalid_start_is_refused(tmp_path: Path, text: str, needle: str):
    with pytest.raises(InputError) as caught:
        load_config(write_scene(tmp_path, text))
    assert needle in str(caught.value)
    assert str(tmp_path / "scene.yaml:7: ") in str(caught.value)


NETWORK = "mesh: {}\n{}time_step: 0.1\nframes: 1\neffects: [{{kind: springs, scaling_rule: fixed, stretch: 1}}]\n"
PAIR = "positions: [[0, 0, 0], [1, 0, 0]]"


@pytest.mark.parametrize(
    ("mesh", "mass", "needles"),
    [
        ("{kind: network, positions: []}", "mass: 1\n", ["mesh.positions"]),
        ("{kind: network, positions: [[0, .nan, 0]]}", "mass: 1\n", ["mesh.positions[0][1]"]),
        ("{kind: network, positions: [[0, .inf, 0]]}", "mass: 1\n", ["mesh.positions[0][1]"]),
        ("{kind: network, positions: [[0, 0]]}", "mass: 1\n", ["mesh.positions[0]"]),
        (f"{{kind: network, {PAIR}, springs: [[0, 1], [1, 1]]}}", "mass: 1\n", ["mesh.springs", "1 to itself"]),
        (f"{{kind: network, {PAIR}, shear: [[0, 2]]}}", "mass: 1\n", ["mesh.shear", "vertex 2", "0 to 1"]),
        (f"{{kind: network, {PAIR}, springs: [[0, -1]]}}", "mass: 1\n", ["mesh.springs[0][1]"]),
        (f"{{kind: network, {PAIR}, mass: [1]}}", "", ["mesh.mass", "1 masses for 2 vertices"]),
        (f"{{kind: network, {PAIR}, mass: [1, -1]}}", "", ["mesh.mass[1]"]),
        (f"{{kind: network, {PAIR}, mass: [0, 0]}}", "", ["mesh.mass", "zero at every vertex"]),
        (f"{{kind: network, {PAIR}, mass: [1, 0]}}", "", ["mesh", "some vertices, 1 in all (1)", "give them mass"]),
        (f"{{kind: network, {PAIR}}}", "", ["mass", "is missing"]),
    ],
)
def test_a_network_that_cannot_be_simulated_is_refused_with_its_place_and_a_remedy(
    tmp_path: Path, mesh: str, mass: str, needles: list[str]
):
    with pytest.raises(InputError) as caught:
        load_config(write_scene(tmp_path, NETWORK.format(mesh, mass)))
    assert len(caught.value.mistakes) == 1
    assert str(tmp_path / "scene.yaml:") in str(caught.value)
    for needle in needles:
        assert needle in str(caught.value)


def test_a_massless_vertex_may_be_pinned(tmp_path: Path):
    text = NETWORK.format(f"{{kind: network, {PAIR}, mass: [1, 0]}}", "")
    pinned = text.replace("stretch: 1}]", "stretch: 1}, {kind: pins, indices: [1]}]")
    assert len(load_config(write_scene(tmp_path, pinned)).list_runs()) == 1


def test_a_network_is_read_as_it_was_written():
    mesh = NetworkMesh(
        positions=((0, 0, 0), (3, 0, 0), (3, 4, 0)), springs=((0, 1), (1, 0)), bend=((0, 2),), mass=(1.0, 0.0, 3.0)
    ).build_mesh()
    np.testing.assert_array_equal(mesh.springs, [[0, 1], [1, 0], [0, 2]])
    np.testing.assert_array_equal(mesh.rest_lengths, [3, 3, 5])
    assert {name: list(part) for name, part in mesh.spring_families.items()} == {
        "stretch": [0, 1],
        "shear": [],
        "bend": [2],
    }
    np.testing.assert_array_equal(mesh.mass, [1, 0, 3])
    assert mesh.spacing == 3.0


def test_a_star_has_a_hub_of_as_many_springs_as_its_size():
    mesh = StarMesh(radius=2.0).build_mesh(1000)
    assert np.bincount(mesh.springs.ravel())[0] == 1000
    np.testing.assert_allclose(mesh.rest_lengths, 2.0, rtol=1e-15)
    np.testing.assert_allclose(mesh.mass_fractions[0], 0.5, rtol=1e-12)
    assert PinsEffect(parts=("hub",)).select_vertices(mesh, "pins").tolist() == [0]
