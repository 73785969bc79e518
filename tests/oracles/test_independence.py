"""The reference implementation shares no formula with the solvers and the scenes."""

from __future__ import annotations

import ast
from pathlib import Path

FORBIDDEN_MODULES = (
    *(f"springbench.solvers.{name}" for name in ("contact", "iteration", "kernels", "linalg", "methods", "simd")),
    *(f"springbench.solvers.model.{name}" for name in ("energies", "integrators", "system_matrix_assembly")),
    *(
        f"springbench.harness.scenes.{name}"
        for name in ("spring_stiffness", "key_frames", "primitive_obstacles", "vertex_selectors")
    ),
)
"""Modules that state a formula which the reference implementation states too."""
PLANTS_ERRORS = ("test_", "planted_errors.py")
"""Beginnings of the names of files that are no part of it: they replace formulas of the solvers by wrong ones."""


def find_forbidden_imports(source: str) -> set[str]:
    """Return the modules of FORBIDDEN_MODULES that a source imports, or that it imports from."""
    imported = set[str]()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imported |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports are not read here"
            imported |= {f"{node.module}.{one.name}" for one in node.names}
    return {module for module in FORBIDDEN_MODULES for name in imported if f"{name}.".startswith(f"{module}.")}


def test_no_module_imports_a_formula_of_the_solvers():
    files = [path for path in Path(__file__).parent.glob("*.py") if not path.name.startswith(PLANTS_ERRORS)]
    assert len(files) > 10
    assert {path.name: found for path in files if (found := find_forbidden_imports(path.read_text()))} == {}


def test_each_form_of_importing_a_formula_is_found():
    assert find_forbidden_imports("import springbench.solvers.contact.ccd as ccd") == {"springbench.solvers.contact"}
    found = find_forbidden_imports("from springbench.solvers.model import energies, step_problem")
    assert found == {"springbench.solvers.model.energies"}
    found = find_forbidden_imports("def f():\n    from springbench.harness.scenes.key_frames import KeyFrame")
    assert found == {"springbench.harness.scenes.key_frames"}
