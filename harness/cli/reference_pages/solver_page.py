"""Reference page of solvers and integrators, from the metadata of their classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from json import dumps
from typing import Any

from springbench.harness.cli.reference_pages.config_pages import SchemaWriter, format_default
from springbench.harness.cli.reference_pages.markdown_text import format_docstring, format_table, read_section_entries
from springbench.harness.config.json_schema import build_json_schema
from springbench.harness.report.citations import format_citation
from springbench.solvers.model.integrators import INTEGRATORS, SUBSTEPPING
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, find_solver_info, is_minimiser, load_target

_INTRODUCTION = """# Solvers

For users who choose or compare solvers: the update, the cost and the source of each method, and its parameters.

A solve is a solve with the factor of Q, a pass visits each spring once. [Notation](../explanation/notation.md) defines
the letters, and [choosing a solver](../howto/choose-a-solver.md) says which method wins where. A method that is no
minimiser does not reduce the residual; it is scored by its motion."""

_INTEGRATOR_TEXT = """## Integrators

The order is that of smooth problems with springs and pins at rest. [The step and its
objective](../explanation/step-and-objective.md) lists the order by effect. The embedded order is that of the error
estimate for `springbench run SCENE --error`."""


def build_solver_page() -> str:
    """Build the page of all shipped solvers and integrators."""
    solvers: dict[str, Any] = {
        name: load_target(target) for table in (SOLVERS, OPTIONAL_SOLVERS) for name, target in table.items()
    }
    rows = (_summarise_solver(name, solver) for name, solver in solvers.items())
    integrators = (
        (f"`{name}`", str(one.order), str(one.num_stages), str(getattr(one, "embedded_order", 0) or ""))
        for name, one in INTEGRATORS.items()
        if one is not SUBSTEPPING
    )
    return "\n\n".join(
        [
            _INTRODUCTION,
            format_table(("solver", "family", "an iteration", "its cost", "minimiser", "source"), rows),
            _INTEGRATOR_TEXT,
            format_table(("integrator", "order", "stages", "embedded order"), integrators),
            "## Parameters",
            "A sweep gives parameters with the name: `{name: newton, indefinite_strategy: clamp}`.",
            *_describe_parameters(solvers),
        ]
    )


def _summarise_solver(name: str, solver: Any) -> tuple[str, ...]:
    info = find_solver_info(solver, name)
    citation = dumps(asdict(info.citation)) if info.citation else None
    minimiser = "yes" if is_minimiser(solver) else "no"
    return (f"`{name}`", info.family, info.formula, info.cost, minimiser, format_citation(citation))


def _describe_parameters(solvers: Mapping[str, Any]) -> list[str]:
    parts: list[str] = []
    definitions = build_json_schema()["$defs"]
    writer = SchemaWriter(definitions, {}, "solvers.md")
    for name, solver in solvers.items():
        texts = read_section_entries(solver.__doc__, "Args")
        rows = [
            (f"`{key}`", writer.format_type(one), format_default(one, False), texts.get(key, ""))
            for key, one in definitions[name]["properties"].items()
            if key != "name"
        ]
        if rows:
            table = format_table(("parameter", "type", "default", "meaning"), rows)
            parts += [f"### {name}", format_docstring(solver.__doc__, with_arguments=False), table]
    return parts
