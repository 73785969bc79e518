"""Planted errors in readers of meshes and in what they make of faces: name, file, fragment, replacement, test."""

from __future__ import annotations

from tests.mutations.base import Mutation

_FOLDER = "harness/scenes/mesh"
_FILES, _CLEANING, _FOREIGN, _FACES, _REPORT = (
    f"tests/unit/test_{name}.py"
    for name in ("mesh_files", "mesh_cleaning", "foreign_mesh_files", "polygon_faces", "mesh_report")
)

_TABLE = (
    ("obj-from-the-end", f"{_FOLDER}/obj_reader.py", "else len(self.points) + index)", "else -1 - index)", _FILES),
    (
        "obj-continued-line-number",
        f"{_FOLDER}/obj_reader.py",
        "        begun = begun or number\n",
        "        begun = number\n",
        f"{_FILES}::test_a_mistake_in_a_continued_line_has_the_line_in_which_it_begins",
    ),
    (
        "ply-list-with-its-length",
        f"{_FOLDER}/ply_reader.py",
        "table[:, first + 1 : first + 1 + int(table[0, first])]",
        "table[:, first : first + int(table[0, first])]",
        f"{_FOREIGN}::test_other_properties_and_elements_of_a_ply_are_skipped",
    ),
    ("inch-of-a-foot", f"{_FOLDER}/mesh_cleaning.py", '"in": 0.0254', '"in": 0.3048', _CLEANING),
    (
        "up-axis-mirrored",
        f"{_FOLDER}/mesh_cleaning.py",
        '"z": ((0, 2, 1), (1.0, 1.0, -1.0))',
        '"z": ((0, 2, 1), (1.0, 1.0, 1.0))',
        f"{_CLEANING}::test_the_up_axis_becomes_y_by_a_rotation",
    ),
    (
        "weld-of-numbers-in-file",
        f"{_FOLDER}/mesh_cleaning.py",
        "file_numbers=None if cells.file_numbers is None else cells.file_numbers[remains]",
        "file_numbers=cells.file_numbers",
        f"{_CLEANING}::test_a_seam_is_welded_with_its_groups_and_numbers",
    ),
    (
        "quad-by-its-longer-diagonal",
        f"{_FOLDER}/polygon_triangulation.py",
        "other = one > (1.0 + _EQUAL_TOLERANCE) * two",
        "other = two > (1.0 + _EQUAL_TOLERANCE) * one",
        f"{_FACES}::test_a_quadrangle_is_cut_by_its_shorter_diagonal_and_an_equal_one_by_the_lowest_vertex",
    ),
    (
        "quad-mass-by-triangles",
        f"{_FOLDER}/polygon_triangulation.py",
        "shares = (t + np.roll(t, 1, axis=1)) / 3 + t.sum(axis=1, keepdims=True) / (3 * faces.shape[1])",
        "shares = (t + np.roll(t, 1, axis=1)) / 2",
        f"{_FACES}::test_a_quadrangle_gives_its_corners_half_of_each_diagonals_thirds",
    ),
    (
        "repeated-face-weighs-twice",
        f"{_FOLDER}/polygon_triangulation.py",
        "    first[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]\n",
        "    first[order] = order\n",
        f"{_FACES}::test_a_repeated_face_counts_once_with_a_warning",
    ),
    (
        "gltf-mirror-keeps-outside",
        f"{_FOLDER}/gltf_reader.py",
        "self._triangles.append(cells[:, ::-1] if flips else cells)",
        "self._triangles.append(cells)",
        "tests/unit/test_gltf_reader.py::test_nodes_place_and_mirror_their_meshes",
    ),
    (
        "flat-is-any-sliver",
        f"{_FOLDER}/mesh_cleaning.py",
        "FLAT_RATIO = 1e-6",
        "FLAT_RATIO = 1e-2",
        f"{_REPORT}::test_each_fault_is_found_with_its_place_and_remedy",
    ),
)

MESH_FILES = tuple(Mutation(name, file, old, new, (test,)) for name, file, old, new, test in _TABLE)
