"""Reference stiffness by areas: virtual work of a uniform stretch, face by face, with dense matrices.

A sheet with Poisson's ratio 1/3 and stiffness E [N/m] stores E / (1 - 1/3) e^2 = 3/2 E e^2 for each unit of area when
it is stretched by e in all directions. A spring of length L and stiffness k stores k/2 (e L)^2. The sides of a triangle
store as much as its area A if k L^2 = E A for each. A quadrangle is stretched along two directions, two sides each:
k L^2 = E A / 2, so that squares have E for each metre of width; a face of n sides has 2/n E A. A diagonal of a
quadrangle has k L^2 = 2 E A; all diagonals of a larger face share 4 E A.

Inner vertices are then released in the tangent plane, and each part is scaled by the ratio of both energies.
"""

from __future__ import annotations

import numpy as np
from springbench.harness.scenes.mesh.mesh import Mesh

from tests.oracles.scene_declaration import Array


def compute_area_scale(mesh: Mesh) -> Array:
    """Compute the stiffness (m,) of each spring of a surface for the constant 1, with vertices at rest in space."""
    springs = [frozenset(pair) for pair in mesh.springs.tolist()]
    represented = dict.fromkeys(springs, 0.0)
    for sides, diagonals, area in list_faces(mesh):
        for pair in sides:
            represented[pair] += area if len(sides) == 3 else 2 * area / len(sides)
        for pair in diagonals & represented.keys():
            represented[pair] += 4 * area / len(diagonals)
    ends = mesh.rest_positions[mesh.springs]
    length = np.sqrt(((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1))
    k = np.array([represented[pair] for pair in springs]) / length**2
    left = _release_inner_vertices(mesh, k, length)
    part = _number_parts(mesh)
    for number in set(part):
        of = [part[i] == number for i in mesh.springs[:, 0]]
        k[of] *= (k[of] @ length[of] ** 2) / (k[of] @ left[of] ** 2)
    return k


def list_faces(mesh: Mesh) -> list[tuple[set[frozenset[int]], set[frozenset[int]], float]]:
    """List sides, diagonals and area of each face: triangles are joined across edges that are no side."""
    declared = {frozenset(pair) for pair in mesh.springs[mesh.spring_families["stretch"]].tolist()}
    corners = [set(triangle) for triangle in mesh.triangles.tolist()]
    areas = [_triangle_area(mesh.rest_positions[triangle]) for triangle in mesh.triangles]
    edges = [{frozenset(t - {v}) for v in t} for t in corners]
    faces = [[k] for k in range(len(corners))]
    owner = list(range(len(corners)))
    for a in range(len(corners)):
        for b in range(a):
            if owner[a] != owner[b] and (edges[a] & edges[b]) - declared:
                gone = owner[a]
                faces[owner[b]] += faces[gone]
                for k in faces[gone]:
                    owner[k] = owner[b]
                faces[gone] = []
    found = list[tuple[set[frozenset[int]], set[frozenset[int]], float]]()
    for face in filter(None, faces):
        around = set[int]().union(*(corners[k] for k in face))
        sides = set[frozenset[int]]().union(*(edges[k] for k in face)) & declared
        pairs = {frozenset((i, j)) for i in around for j in around if i < j}
        found.append((sides, pairs - sides, sum(areas[k] for k in face)))
    return found


def _triangle_area(corners: Array) -> float:
    """Return the area of a triangle (3, 3) by Gram's determinant."""
    sides = corners[1:] - corners[0]
    return float(np.sqrt(max(0.0, np.linalg.det(sides @ sides.T)))) / 2


def _release_inner_vertices(mesh: Mesh, k: Array, length: Array) -> Array:
    """Return the elongation (m,) of springs under a unit stretch whose inner vertices are in equilibrium."""
    n, count = len(mesh.rest_positions), dict[frozenset[int], int]()
    normal = np.zeros((n, 3))
    for a, b, c in mesh.triangles.tolist():
        p, q, r = mesh.rest_positions[[a, b, c]]
        normal[[a, b, c]] += np.cross(q - p, r - p)
        for pair in (frozenset((a, b)), frozenset((b, c)), frozenset((c, a))):
            count[pair] = count.get(pair, 0) + 1
    border = set[int]().union(*(pair for pair, times in count.items() if times == 1))
    inner = [v for v in range(n) if v not in border and normal[v].any()]
    column = {v: 2 * place for place, v in enumerate(inner)}
    moved = np.zeros((len(k), 2 * len(inner)))
    for e, (i, j) in enumerate(mesh.springs.tolist()):
        unit = (mesh.rest_positions[j] - mesh.rest_positions[i]) / length[e]
        for v, sign in ((i, -1.0), (j, 1.0)):
            if v in column:
                tangents = np.linalg.svd(normal[v][None])[2][1:]  # two directions across the normal
                moved[e, column[v] : column[v] + 2] += sign * tangents @ unit
    if not inner:
        return length
    weight = np.sqrt(k)
    answer = np.linalg.lstsq(weight[:, None] * moved, -weight * length, rcond=1e-10)[0]
    return length + moved @ answer


def _number_parts(mesh: Mesh) -> list[int]:
    """Return the smallest vertex that is connected with each vertex by springs."""
    least, changed = list(range(len(mesh.rest_positions))), True
    while changed:
        changed = False
        for i, j in mesh.springs.tolist():
            low = min(least[i], least[j])
            changed |= least[i] != low or least[j] != low
            least[i] = least[j] = low
    return least
