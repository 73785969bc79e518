"""Networks whose springs have rest lengths, stiffness and prestress of their own, and their closed answers."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.optimize import brentq
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.energies.tension_only_energy import TensionOnlySprings
from springbench.solvers.model.step_problem import Positions, StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
LINE = "positions: [[0, 0, 0], [2, 0, 0], [3, 0, 0]], springs: [[0, 1], [1, 2]]"


def simulate_network(
    name: str, frames: int, solver: str = "newton", time_step: float | None = None
) -> tuple[Scene, Positions]:
    """Return a shipped scene and its positions after some steps, each solved to round-off."""
    spec = load_scene(SCENES / f"{name}.yaml")
    scene = build_scene(spec.with_time_step(time_step or spec.time_step), 0, log_warnings=False)
    steps = simulate_scene(
        scene,
        prepare(scene, load_target(SOLVERS[solver])()),
        StopRule(2000, 1e-12),
        initial_guess="previous",
        frames=frames,
    )
    return scene, list(steps)[-1].positions


def compute_tensions(scene: Scene, p: Positions) -> np.ndarray:
    springs = scene.all_springs
    return springs.stiffness * (springs.edge_lengths(p) - springs.rest_length)


def load_text(tmp_path: Path, mesh: str, springs: str = "") -> Scene:
    path = tmp_path / "scene.yaml"
    path.write_text(f"mesh: {{{mesh}}}\nmass: 1\ntime_step: 0.1\nframes: 1\neffects: [{{kind: springs{springs}}}]\n")
    return build_scene(load_scene(path), 0)


@pytest.mark.parametrize(
    "solver", ["hybrid", *(pytest.param(name, marks=pytest.mark.slow) for name in ("newton", "lbfgs", "vbd"))]
)
def test_a_prism_in_self_stress_stays_at_rest(solver: str):
    scene, p = simulate_network("tensegrity-prism", 60, solver)
    # A force of 241 N has a round-off of 3e-14 N; accumulated over 60 steps of a prism of 1 kg it moves it by 1e-12 m.
    np.testing.assert_allclose(p, scene.mesh.rest_positions, rtol=0, atol=2e-12)
    expected = np.repeat([-240.81192050387907, 86.60254037844386, 178.9123219435526], [3, 6, 3])
    np.testing.assert_allclose(compute_tensions(scene, p), expected, rtol=1e-9)


def test_a_cable_net_returns_to_the_shape_that_the_force_density_method_finds():
    scene, p = simulate_network("cable-net", 60, time_step=0.1)
    x, y, z = p.T
    np.testing.assert_allclose(y, 0.1 * x * z, rtol=0, atol=1e-9)
    np.testing.assert_allclose(p, scene.mesh.rest_positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(compute_tensions(scene, p), 5000.0 * scene.mesh.spring_distances, rtol=1e-6)


def test_force_densities_alone_find_the_shape_of_a_net(tmp_path: Path):
    """The interior starts flat; a spring of rest length 0 has its force density in every shape (Schek 1974)."""
    table = (SCENES / "cable-net" / "vertices.csv").read_text().splitlines()
    flat = [line if line.endswith("1") else ",".join([(c := line.split(","))[0], "0", *c[2:]]) for line in table[1:]]
    (tmp_path / "vertices.csv").write_text("\n".join([table[0], *flat]))
    pairs = [",".join(line.split(",")[:2]) for line in (SCENES / "cable-net" / "cables.csv").read_text().splitlines()]
    (tmp_path / "cables.csv").write_text("\n".join(pairs))
    (tmp_path / "net.yaml").write_text(
        "mesh: {kind: network, vertex_table: vertices.csv, spring_table: cables.csv, force_density: 7}\n"
        "mass: 1\ntime_step: 10\nframes: 20\neffects:\n  - {kind: springs}\n"
        "  - {kind: pins, attribute: {name: boundary, low: 1}, weight: exact}\n"
    )
    scene = build_scene(load_scene(tmp_path / "net.yaml"), 0, log_warnings=False)
    solver = prepare(scene, load_target(SOLVERS["newton"])())
    *_, last = simulate_scene(scene, solver, StopRule(50, 1e-12), initial_guess="previous", frames=20)
    x, y, z = last.positions.T
    np.testing.assert_allclose(y, 0.1 * x * z, rtol=0, atol=1e-9)


def solve_discrete_catenary(num_springs: int, span: float = 8.0) -> tuple[float, Positions]:
    """Return horizontal tension [N] and vertices of springs of EA 2 kN and 10 m in all, which weigh 98.1 N."""
    rest, weight = 10.0 / num_springs, 10.0 * 9.81 / num_springs

    def hang(horizontal: float) -> Positions:
        vertical = (num_springs - 1) * weight / 2 - weight * np.arange(num_springs)
        tension = np.hypot(horizontal, vertical)
        length = rest * (1.0 + tension / 2000.0)
        steps = np.column_stack([horizontal * length / tension, -vertical * length / tension, 0 * length])
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    horizontal = brentq(lambda h: hang(h)[-1, 0] - span, 1.0, 500.0, xtol=1e-13)
    return horizontal, hang(horizontal)


def test_a_slack_cable_falls_into_the_elastic_catenary():
    scene, p = simulate_network("elastic-catenary", 150, time_step=0.1)
    horizontal, expected = solve_discrete_catenary(20)
    np.testing.assert_allclose(p, expected, rtol=0, atol=1e-6)
    tension = compute_tensions(scene, p)
    known = [np.hypot(horizontal, 98.1 / 40), 56.0284137303]
    np.testing.assert_allclose([tension.min(), tension.max()], known, rtol=1e-4)
    # The continuous cable (Irvine 1981, section 1.3) is approached in proportion to the squared length of its springs.
    errors = [2.810036113534 - -solve_discrete_catenary(n)[1][:, 1].min() for n in (20, 40, 80)]
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 4.0, rtol=0.02)


@pytest.mark.parametrize(
    ("values", "stiffness", "rest"),
    [
        ("stiffness: 100", [100, 100], [2, 1]),
        ("stiffness: [100, 50], rest_length: [1.5, 0]", [100, 50], [1.5, 0]),
        ("axial_stiffness: 100, rest_length: 1.25", [80, 80], [1.25, 1.25]),
        ("stiffness: 100, tension: [20, -10]", [100, 100], [1.8, 1.1]),
        ("stiffness: 100, force_density: 10", [100, 100], [1.8, 0.9]),
        ("axial_stiffness: 100, tension: 25", [62.5, 125], [1.6, 0.8]),
        ("axial_stiffness: 100, force_density: [12.5, 25]", [62.5, 125], [1.6, 0.8]),
        ("force_density: [3, 5]", [3, 5], [0, 0]),
    ],
)
def test_stiffness_and_rest_length_follow_from_what_is_stated(tmp_path, values: str, stiffness: list, rest: list):
    scene = load_text(tmp_path, f"kind: network, {LINE}, {values}")
    np.testing.assert_allclose(scene.all_springs.stiffness, stiffness, rtol=1e-14)
    np.testing.assert_allclose(scene.all_springs.rest_length, rest, rtol=1e-14)


def test_properties_of_springs_are_read_only(tmp_path: Path):
    properties = load_text(tmp_path, f"kind: network, {LINE}, stiffness: 3").mesh.spring_properties
    assert properties is not None
    for array in (properties.stiffness, properties.rest_length, properties.only_pulls):
        assert not array.flags.writeable


def test_springs_without_a_stiffness_of_their_own_have_that_of_the_effect(tmp_path: Path):
    scene = load_text(tmp_path, f"kind: network, {LINE}, stiffness: [7, null], rest_length: [1, 0.5]", ", stretch: 10")
    np.testing.assert_allclose(scene.all_springs.stiffness, [7, 20])
    with pytest.raises(InputError, match=r"`stretch` is missing: 1 of 2 springs"):
        load_text(tmp_path, f"kind: network, {LINE}, stiffness: [7, null]")
    with pytest.raises(InputError, match=r"`stretch` has no effect"):
        load_text(tmp_path, f"kind: network, {LINE}, stiffness: 7", ", stretch: 10")
    with pytest.raises(InputError, match=r"`stretch` is missing: 2 of 2"):
        load_text(tmp_path, f"kind: network, {LINE}")


@pytest.mark.parametrize(
    ("values", "needles"),
    [
        ("stiffness: 1, axial_stiffness: 1", ["mesh.axial_stiffness", "spring 0", "give one of the two"]),
        ("stiffness: 1, rest_length: 1, tension: 1", ["mesh.tension", "give one of the two"]),
        ("stiffness: 1, rest_length: 1, force_density: 1", ["mesh.force_density", "give one of them"]),
        ("stiffness: [1]", ["mesh.stiffness", "1 values for 2 springs"]),
        ("stiffness: [1, -1]", ["mesh.stiffness", "spring 1", "-1 is negative"]),
        ("tension: 5", ["mesh.tension", "5 needs a `stiffness`"]),
        ("force_density: [1, -2]", ["mesh.force_density", "spring 1", "-2 is compression"]),
        ("stiffness: 1, tension: 5", ["mesh.tension", "negative rest length"]),
        ("axial_stiffness: 1, tension: -5", ["mesh.tension", "compresses it to nothing"]),
        ("axial_stiffness: 1, rest_length: 0", ["mesh.axial_stiffness", "rest length above 0"]),
        ("stiffness: 9, tension: -1, tension_only: true", ["mesh.tension", "only pulls"]),
        ("stiffness: EA", ["mesh.stiffness", "names the column 'EA'", "has none"]),
        ("stiffness: true", ["mesh.stiffness"]),
        ("tension_only: 1", ["mesh.tension_only"]),
    ],
)
def test_values_that_contradict_are_refused_with_their_place(tmp_path: Path, values: str, needles: list[str]):
    with pytest.raises(InputError) as caught:
        load_text(tmp_path, f"kind: network, {LINE}, {values}")
    for needle in [str(tmp_path / "scene.yaml:1: "), *needles]:
        assert needle in str(caught.value)


MEMBERS = "i,j,EA,T\n1,0,100,25\n1,2,200,\n"


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_states_springs_and_their_values(tmp_path: Path, suffix: str):
    if suffix == "csv":
        (tmp_path / "t.csv").write_bytes(b"\xef\xbb\xbf" + MEMBERS.replace("\n", "\r\n").encode())
    else:
        columns = {"i": [1, 1], "j": [0, 2], "EA": [100, 200], "T": [25.0, None], "note": ["a", "b"]}
        pyarrow.parquet.write_table(pa.table(columns), tmp_path / "t.parquet")
    mesh = f"kind: network, positions: [[0, 0, 0], [2, 0, 0], [3, 0, 0]], spring_table: t.{suffix}"
    scene = load_text(tmp_path, f"{mesh}, axial_stiffness: EA, tension: T, tension_only: true")
    np.testing.assert_array_equal(scene.mesh.springs, [[1, 0], [1, 2]])
    np.testing.assert_allclose(scene.all_springs.stiffness, [62.5, 200])
    np.testing.assert_allclose(scene.all_springs.rest_length, [1.6, 1])
    assert [type(energy) for energy in scene.system.energies] == [TensionOnlySprings]


@pytest.mark.parametrize(
    ("table", "needles"),
    [
        ("", ["t.csv", "is empty"]),
        ("i,j,EA,T\n", ["has no rows"]),
        ("i;j\n0;1\n", ["no column 'i'", "by commas"]),
        ("a,j\n0,1\n", ["no column 'i'", "one of a, j"]),
        ("i,j,j\n0,1,1\n", ["t.csv:1", "each column once"]),
        ("i,j\n0\n", ["t.csv:2", "1 cells for 2 columns"]),
        ("i,j\n0,1\n0,7\n", ["t.csv:3", "j is 7; the vertices are 0 to 2"]),
        ("i,j\n0,1\n1,0.5\n", ["t.csv:3", "j is 0.5"]),
        ('i,j,note\n0,1,"of two\nlines"\n1,7,\n', ["t.csv:4", "j is 7"]),
        ('i,j,note\n0,1,"of two\nlines"\n1,2\n', ["t.csv:4", "2 cells for 3 columns"]),
        ("i,j\n1,1\n", ["t.csv:2", "joins a vertex to itself"]),
        ("i,j\n0,x\n", ["t.csv:2", "j is 'x'"]),
        ("i,j,T\n0,1,1\n", ["names the column 'EA'", "one of T, i, j"]),
        ("version https://git-lfs.github.com/spec/v1\n", ["Git LFS pointer"]),
    ],
)
def test_a_table_that_is_wrong_is_refused_with_its_line(tmp_path: Path, table: str, needles: list[str]):
    (tmp_path / "t.csv").write_text(table)
    mesh = "kind: network, positions: [[0, 0, 0], [2, 0, 0], [3, 0, 0]], spring_table: t.csv, axial_stiffness: EA"
    with pytest.raises(InputError) as caught:
        load_text(tmp_path, mesh)
    for needle in needles:
        assert needle in str(caught.value)


def test_vertices_come_from_a_table_with_masses_and_attributes(tmp_path: Path):
    (tmp_path / "v.csv").write_text("x,y,z,mass,fixed\n0,0,0,2,1\n1,0,0,3,0\n")
    mesh = NetworkMesh(vertex_table=tmp_path / "v.csv", springs=((0, 1),)).build_mesh()
    np.testing.assert_array_equal(mesh.rest_positions, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(mesh.mass, [2, 3])
    np.testing.assert_array_equal(mesh.attributes["fixed"], [1, 0])
    assert mesh.spring_properties is None
    with pytest.raises(InputError, match=r"vertex_table: there is no file"):
        load_text(tmp_path, "kind: network, vertex_table: missing.csv")
    with pytest.raises(InputError, match=r"either `positions` or a `vertex_table`"):
        load_text(tmp_path, "kind: network, springs: []")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["vtu", "vtp"])
def test_lines_of_a_file_state_values_of_its_springs(tmp_path: Path, suffix: str):
    path, points, lines = tmp_path / f"net.{suffix}", [[0.0, 0, 0], [2, 0, 0], [3, 0, 0]], [[0, 1], [1, 2]]
    if suffix == "vtu":
        meshio.Mesh(points, [("line", lines)], cell_data={"EA": [[100.0, 200.0]]}).write(path)
    else:
        pyvista = pytest.importorskip("pyvista")
        made = pyvista.PolyData(np.array(points), lines=np.array([[2, *line] for line in lines]).ravel())
        made.cell_data["EA"] = [100.0, 200.0]
        made.save(path)
    scene = load_text(tmp_path, f"kind: file, path: net.{suffix}, axial_stiffness: EA, rest_length: 0.5")
    np.testing.assert_allclose(scene.all_springs.stiffness, [200, 400])
    np.testing.assert_allclose(scene.all_springs.rest_length, 0.5)
    with pytest.raises(InputError, match=r"names the column 'E'; expected one of EA"):
        load_text(tmp_path, f"kind: file, path: net.{suffix}, axial_stiffness: E")


def test_a_table_states_values_of_some_edges_of_a_mesh(tmp_path: Path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "t.csv").write_text("i,j,stiffness\n2,1,9\n")
    scene = load_text(tmp_path, "kind: file, path: m.obj, spring_table: t.csv", ", stretch: 5")
    stiffness = {
        tuple(sorted(e)): k for e, k in zip(scene.all_springs.edges.tolist(), scene.all_springs.stiffness, strict=True)
    }
    assert stiffness == {(0, 1): 5.0, (0, 2): 5.0, (1, 2): 9.0}
    (tmp_path / "t.csv").write_text("i,j,stiffness\n2,1,9\n1,2,9\n")
    with pytest.raises(InputError, match=r"t\.csv:3: the spring 1-2 has a row already"):
        load_text(tmp_path, "kind: file, path: m.obj, spring_table: t.csv", ", stretch: 5")


def test_values_of_springs_are_a_part_of_a_runs_identity(tmp_path: Path):
    def digest(values: str) -> str:
        path = tmp_path / "scene.yaml"
        path.write_text(
            f"mesh: {{kind: network, {LINE}{values}}}\nmass: 1\ntime_step: 0.1\nframes: 1\n"
            "effects: [{kind: springs, stretch: 1}]\n"
        )
        return load_scene(path).scene_digest

    given = ["", ", rest_length: 1", ", rest_length: 1.5", ", tension_only: true", ", stiffness: [2, null]"]
    assert len({digest(values) for values in given}) == len(given)


def test_a_slack_spring_pushes_nothing():
    scene = build_scene(load_scene(SCENES / "elastic-catenary.yaml"), 0)
    (cables,) = scene.system.energies
    assert isinstance(cables, TensionOnlySprings)
    p = scene.mesh.rest_positions
    assert cables.value(p) == 0.0
    assert not cables.hessian(p).nnz
    gradient, projection = np.zeros_like(p), np.zeros_like(p)
    cables.add_gradient(p, gradient)
    assert not gradient.any()
    cables.add_projection(p, projection)
    np.testing.assert_allclose(projection, cables.stiffness_matrix(len(p)) @ p, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_solvers_without_slack_springs_refuse_them_by_name():
    scene, refused = build_scene(load_scene(SCENES / "elastic-catenary.yaml"), 0), set[str]()
    for name in set(SOLVERS) - {"dense"}:
        solver = load_target(SOLVERS[name])()
        try:
            prepare(scene, solver)
        except Unsupported:
            refused.add(name)
            with pytest.raises(Unsupported, match="TensionOnlySprings"):
                prepare(scene, solver)
    assert refused == {
        "xpbd", "xpbd-small-steps", "mgpbd", "symplectic-euler", "velocity-verlet", "blanes-moan-4", "blanes-moan-6",
        "runge-kutta-4", "tsitouras-5", "dormand-prince-8",
    }  # fmt: skip


def test_the_networks_are_runs_of_a_sweep():
    for name in ("tensegrity-prism", "cable-net", "elastic-catenary"):
        assert len(load_config(SCENES / f"{name}.yaml").list_runs()) == 1
