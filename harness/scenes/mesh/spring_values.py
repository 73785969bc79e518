# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""Rest length, stiffness and prestress of each spring of a network or a file's mesh.

For each spring at most one of stiffness k and axial stiffness EA is stated, and at most one of rest length r, tension T
and force density q = T / l, where l is the distance of its ends in the mesh:

    k = EA / r        r = l - T / k        r = l / (1 + T / EA)        T = q l

A force density without any stiffness makes a spring of rest length 0 and stiffness q. Its force density is q in every
shape, so that the equilibrium of such springs is that of the force density method (Schek 1974).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.scenes.mesh.mesh import SpringProperties
from springbench.harness.scenes.mesh.mesh_topology import IndexArray
from springbench.harness.scenes.mesh.table_reader import DataTable
from springbench.harness.schema.base_model import ConfigModel

Columns = Mapping[str, NDArray[np.float64]]
ColumnName = Annotated[str, Field(min_length=1, max_length=200)]
SpringNumbers = float | tuple[float | None, ...] | ColumnName
"""One number for all springs, a list with one for each, or the name of a column."""
SpringFlags = bool | tuple[bool, ...] | ColumnName
"""One flag for all springs, a list with one for each, or the name of a column."""

VALUE_KEYS = ("stiffness", "axial_stiffness", "rest_length", "tension", "force_density", "tension_only")
"""Keys of the values of springs, and the names of the columns that are read if no key names a column."""


class SpringValueKeys(ConfigModel):
    """Spring values of a mesh, each a number, a list, or a column name."""

    stiffness: SpringNumbers | None = None
    """Stiffness k [N/m] of each spring: one number, a list in the order of the springs, or the name of a column."""
    axial_stiffness: SpringNumbers | None = None
    """Axial stiffness EA [N] of each spring, instead of `stiffness`: k = EA / rest length."""
    rest_length: SpringNumbers | None = None
    """Rest length [m] of each spring; by default the distance of its ends."""
    tension: SpringNumbers | None = None
    """Force [N] of each spring in the shape of the mesh, negative for compression, instead of `rest_length`."""
    force_density: SpringNumbers | None = None
    """Force divided by length [N/m] of each spring in the shape of the mesh, instead of `rest_length`. Without a
    stiffness the spring has this force density in every shape."""
    tension_only: SpringFlags | None = None
    """Whether a spring only pulls: it exerts no force while it is shorter than its rest length."""

    @property
    def states_values(self) -> bool:
        """Whether any of the keys is given."""
        return any(getattr(self, key) is not None for key in VALUE_KEYS)

    def build_spring_properties(
        self, distances: NDArray[np.float64], columns: Columns, *, reads_unnamed: bool = True
    ) -> SpringProperties | None:
        """Build the properties of springs; None if nothing is stated.

        Args:
            distances: distance of the ends of each spring (m,) [m].
            columns: values by name, each (m,), NaN where none is given.
            reads_unnamed: whether columns of the names in `VALUE_KEYS` are read where no key names them.

        Raises:
            InputError: for a missing column, a wrong number of values, and values that contradict each other.
        """
        stated = {key: self._collect_values(key, len(distances), columns, reads_unnamed) for key in VALUE_KEYS}
        if all(values is None for values in stated.values()):
            return None
        none = np.full(len(distances), np.nan)
        k, ea, r, t, q, flags = (none if x is None else x for x in stated.values())
        return _resolve_values(distances, k, ea, r, t, q, flags)

    def _collect_values(self, key: str, m: int, columns: Columns, reads_unnamed: bool) -> NDArray[np.float64] | None:
        """Return the values (m,) of a key; None if there are none.

        The value of a spring is NaN where none is given.
        """
        given = getattr(self, key)
        if given is None:
            return columns.get(key) if reads_unnamed else None
        if isinstance(given, str):
            if given not in columns:
                where = f"expected {format_allowed_names(given, columns)}" if columns else "and this mesh has none"
                raise _make_value_error(f"names the column {given!r}; {where}", key)
            return columns[given]
        if not isinstance(given, tuple):
            return np.full(m, float(given))
        if len(given) != m:
            raise _make_value_error(f"has {len(given)} values for {m} springs; give each spring one", key)
        return np.array([np.nan if value is None else float(value) for value in given])


def match_table_rows(table: DataTable, springs: IndexArray, num_vertices: int) -> IndexArray:
    """Return the spring of each row of a table, by its columns `i` and `j`, (rows,).

    Args:
        table: rows that name springs by their zero-based vertices, in any order.
        springs: vertices of each spring (m, 2); several springs of one pair are used in their order.
        num_vertices: number of vertices.

    Raises:
        InputError: if a row names no spring, or more rows name a pair of vertices than springs join it.
    """
    pairs = read_vertex_pairs(table, num_vertices)
    found = find_springs(pairs, springs)
    if (found < 0).any():
        row = int((found < 0).argmax())
        i, j = pairs[row].tolist()
        known = (np.sort(springs, axis=1) == [min(i, j), max(i, j)]).all(axis=1).any()
        problem = "has a row already; give each spring one" if known else "does not exist in the mesh"
        raise table.make_error(f"the spring {i}-{j} {problem}", row)
    return found


def find_springs(pairs: IndexArray, springs: IndexArray) -> IndexArray:
    """Find the spring that joins each pair of vertices.

    Args:
        pairs: pairs of vertices (r, 2), in either direction.
        springs: vertices of each spring (m, 2); several springs of one pair are used in their order.

    Returns:
        Index of the spring of each pair (r,); -1 if there is none, or each is used by an earlier pair.
    """
    numbers = dict[tuple[int, int], list[int]]()
    for number, (i, j) in reversed(list(enumerate(np.sort(springs, axis=1).tolist()))):
        numbers.setdefault((i, j), []).append(number)
    rows = np.sort(pairs, axis=1).tolist()
    return np.array([numbers[i, j].pop() if numbers.get((i, j)) else -1 for i, j in rows], np.int64)


def read_vertex_pairs(table: DataTable, num_vertices: int) -> IndexArray:
    """Return the columns `i` and `j` of a table, zero-based vertices, (rows, 2).

    Args:
        table: rows of springs.
        num_vertices: number of vertices of the mesh.

    Raises:
        InputError: a column is missing, an entry names no vertex, or a row joins a vertex to itself.
    """
    ends = np.column_stack([table.require_column("i"), table.require_column("j")])
    wrong = ~((ends >= 0) & (ends < num_vertices) & (ends == np.floor(ends)))
    if wrong.any():
        row, side = np.argwhere(wrong)[0]
        raise table.make_error(f"{'ij'[side]} is {ends[row, side]:g}; the vertices are 0 to {num_vertices - 1}", row)
    if (same := ends[:, 0] == ends[:, 1]).any():
        raise table.make_error("joins a vertex to itself; remove it or name another vertex", int(same.argmax()))
    return ends.astype(np.int64)


def spread_columns(columns: Columns, rows: IndexArray, m: int) -> dict[str, NDArray[np.float64]]:
    """Return columns as values of all springs.

    Args:
        columns: values by name, each (rows,).
        rows: spring of each row, (rows,).
        m: number of springs.

    Returns:
        Values by name, each (m,), NaN for springs without a row.
    """
    spread = dict[str, NDArray[np.float64]]()
    for name, values in columns.items():
        spread[name] = np.full(m, np.nan)
        spread[name][rows] = values
    return spread


def _resolve_values(
    distances: NDArray[np.float64],
    k: NDArray[np.float64],
    ea: NDArray[np.float64],
    r: NDArray[np.float64],
    t: NDArray[np.float64],
    q: NDArray[np.float64],
    flags: NDArray[np.float64],
) -> SpringProperties:
    """Compute the stiffness and the rest length of each spring.

    All arguments are of shape (m,), with NaN for values that are not stated.
    """
    has_k, has_ea, has_r, has_t, has_q = (~np.isnan(x) for x in (k, ea, r, t, q))
    _require(~(has_k & has_ea), "has a `stiffness` too; give one of the two", "axial_stiffness")
    _require(~(has_r & has_t), "has a `rest_length` too; give one of the two", "tension")
    _require(~((has_r | has_t) & has_q), "has a `rest_length` or `tension` too; give one of them", "force_density")
    _require(~has_k | (k >= 0.0), "is negative", "stiffness", k)
    _require(~has_ea | (ea >= 0.0), "is negative", "axial_stiffness", ea)
    _require(~has_r | (r >= 0.0), "is negative", "rest_length", r)
    _require(~has_t | has_k | has_ea, "needs a `stiffness` or an `axial_stiffness` with it", "tension", t)
    _require(
        ~has_q | has_k | has_ea | (q >= 0.0),
        "is compression, which needs a `stiffness` or an `axial_stiffness` with it",
        "force_density",
        q,
    )
    only_pulls = np.nan_to_num(flags) != 0.0
    force = np.where(has_t, t, np.where(has_q, q * distances, 0.0))
    _require(~only_pulls | (force >= 0.0), "is compression, and the spring only pulls", "tension", force)
    has_force, key = has_t | has_q, "tension" if has_t.any() else "force_density"
    of_k, of_ea = has_k & has_force, has_ea & has_force
    _require(~of_k | (force <= k * distances), "needs a negative rest length; give more stiffness", key, force)
    _require(~of_ea | (force > -ea), "compresses it to nothing; give more axial stiffness", key, force)
    rest = np.where(has_r, r, distances)
    rest[of_k] = distances[of_k] - np.divide(force, k, out=np.zeros_like(k), where=of_k & (k > 0.0))[of_k]
    rest[of_ea] = distances[of_ea] / (1.0 + np.divide(force, ea, out=np.zeros_like(k), where=of_ea & (ea > 0.0))[of_ea])
    bare = has_q & ~has_k & ~has_ea
    rest[bare] = 0.0
    _require(~has_ea | (rest > 0.0), "needs a rest length above 0; give a `stiffness` instead", "axial_stiffness", ea)
    stiffness = np.where(bare, q, k)
    stiffness[has_ea] = ea[has_ea] / rest[has_ea]
    return SpringProperties(stiffness, rest, only_pulls)


def _require(is_valid: NDArray[np.bool_], problem: str, key: str, values: NDArray[np.float64] | None = None) -> None:
    """Raise InputError for the first spring that is not valid."""
    if not is_valid.all():
        spring = int(np.argmin(is_valid))
        got = "" if values is None else f"{values[spring]:g} "
        raise _make_value_error(f"of spring {spring}, {got}{problem}", key)


def _make_value_error(problem: str, key: str) -> InputError:
    return InputError(InputMistake(problem, key=f"mesh.{key}"))
