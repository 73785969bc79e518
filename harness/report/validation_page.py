# pyright: reportUnknownMemberType=false
# Jinja2's and Matplotlib's stubs do not type most members.
"""Page of a validation: tables in Markdown, and pictures of errors and of textile tests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from springbench.harness.atomic_files import atomic_write
from springbench.harness.report.plot_style import (
    FASTER_COLOUR,
    MUTED_COLOUR,
    PAGE_DPI,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    RULE_COLOUR,
    TEXT_COLOUR,
    WARNING_COLOUR,
)

LIMITS = """What springs cannot do:

* A network of springs has no Poisson's ratio of its own. On square cells the diagonals alone resist shear, and they add
  to the stiffness along the threads.
* Bending is that of an isotropic sheet with one rigidity, of the least curvature. Folds bend fabrics further, where
  they are softer: drape is therefore stiffer than that of a fabric. Friction and hysteresis of yarns are missing.
* Compressed cells resist until the mesh buckles, where yarns yield at once; so drape is stiffer on coarse meshes."""
"""Statement of the model's limits, on every page."""


def write_validation_page(rows: Sequence[dict[str, Any]], solver: str, folder: Path) -> list[Path]:
    """Write `validation.json`, `validation.md`, and the pictures `closed-forms.png` and `fabrics.png` to a folder.

    Args:
        rows: rows of `springbench validate`.
        solver: name of the solver.
        folder: existing folder.

    Returns:
        The paths of the files.
    """
    paths = [folder / f"validation.{suffix}" for suffix in ("json", "md")]
    listed = [{key: value for key, value in row.items() if key not in ("positions", "triangles")} for row in rows]
    with atomic_write(paths[0]) as partial:
        partial.write_text(json.dumps({"solver": solver, "rows": listed}, indent=1) + "\n", encoding="utf-8")
    with atomic_write(paths[1]) as partial:
        partial.write_text(format_validation_page(rows, solver), encoding="utf-8")
    for name, draw in _PICTURES.items():
        if drawn := _select_drawn_rows(rows, name):
            paths.append(folder / name)
            with atomic_write(paths[-1]) as partial:
                draw(drawn, solver, partial)
    return paths


def _select_drawn_rows(rows: Sequence[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """Return the rows of a picture: simulated closed forms, or simulated textile tests."""
    return [row for row in rows if ("errors" if name == CLOSED_FORMS_PICTURE else "bending_length") in row]


def format_validation_page(rows: Sequence[dict[str, Any]], solver: str) -> str:
    """Format the page as Markdown.

    Args:
        rows: rows of `springbench validate`; a part without rows is omitted.
        solver: name of the solver.
    """
    lines = [f"# Validation of `{solver}`", ""]
    for name, alt in (
        (CLOSED_FORMS_PICTURE, "Errors by refinement"),
        (FABRICS_PICTURE, "Textile tests in their bands"),
    ):
        lines += [f"![{alt}]({name})", ""] if _select_drawn_rows(rows, name) else []
    forms = [row for row in rows if row["kind"] == "closed form"]
    if forms:
        lines += [
            "## Closed forms", "",
            "The error is that of the finest level. It is confirmed if discretisation, model and round-off explain it.",
            "",
            "| case | quantity | exact | simulated | error | explained | order | verdict |",
            "|---|---|---|---|---|---|---|---|",
            *map(_format_form, forms), "",
            *(f"* {row['name']}: {row['remark']}" for row in forms if row["remark"]), "",
        ]  # fmt: skip
    tests = [row for row in rows if row["kind"] == "textile test"]
    if tests:
        lines += [
            "## Textile tests", "",
            "Bands: bending lengths from the smallest and largest measured rigidity (Wang, O'Brien and Ramamoorthi "
            "2011); drape coefficients from Cusick's regression (1965) for these bending lengths.",
            "",
            "| fabric | bending length [mm] | band | drape coefficient [%] | band | verdict |",
            "|---|---|---|---|---|---|",
            *map(_format_test, tests), "", LIMITS, "",
        ]  # fmt: skip
    return "\n".join(lines)


def _format_form(row: dict[str, Any]) -> str:
    head = f"| {row['name']} | {row['quantity']} | {row['exact']:.6g} |"
    if "values" not in row:
        return f"{head} | | | | {row['verdict']} |"
    order = "" if row["observed_order"] is None else f"{row['observed_order']:.2f} of {row['order']:g}"
    return (
        f"{head} {row['values'][-1]:.6g} | {row['errors'][-1]:.2g} | {row['explained_error']:.2g} | {order} | "
        f"{row['verdict']} |"
    )


def _format_test(row: dict[str, Any]) -> str:
    if "bending_length" not in row:
        return f"| {row['name']} | | | | | {row['verdict']} |"
    c, drape = row["bending_length"], row["drape_coefficient"]
    return (
        f"| {row['name'].removeprefix('fabric ')} | {1e3 * c['value']:.1f} | {1e3 * c['low']:.1f} to "
        f"{1e3 * c['high']:.1f} | {drape['value']:.0f} | {drape['low']:.0f} to {drape['high']:.0f} | {row['verdict']} |"
    )


def draw_closed_forms(forms: Sequence[dict[str, Any]], solver: str, path: Path) -> None:
    """Draw the errors of closed forms by refinement to a PNG, PAGE_WIDTH pixels wide.

    Args:
        forms: rows of closed forms that have errors by level.
        solver: name of the solver, for the title.
        path: target file.
    """
    with plt.rc_context(PAGE_RC):
        figure = plt.figure(figsize=(PAGE_WIDTH / PAGE_DPI, PAGE_HEIGHT / PAGE_DPI), dpi=PAGE_DPI)
        count = sum(row["verdict"] == "confirmed" for row in forms)
        title = f"{solver}: {count} of {len(forms)} closed forms are confirmed"
        figure.text(0.025, 0.94, title, fontsize=20, weight="bold", va="center")
        _draw_forms(figure, forms)
        figure.savefig(path, format="png")
        plt.close(figure)


def draw_fabrics(tests: Sequence[dict[str, Any]], solver: str, path: Path) -> None:
    """Draw textile tests in their bands to a PNG, 5.2 inches wide at 200 dpi.

    Args:
        tests: rows of textile tests, one for each fabric.
        solver: name of the solver, for the title.
        path: target file.
    """
    bending, drape = (sum(is_in_band(row[key]) for row in tests) for key in ("bending_length", "drape_coefficient"))
    title = f"{solver}: of {len(tests)} fabrics {bending} bending lengths\n"
    title += f"and {drape} drape coefficients lie in their bands"
    with plt.rc_context({**PAGE_RC, "font.size": 8.5}):
        figure = plt.figure(figsize=(5.2, 1.25 + 0.22 * len(tests)), dpi=200, layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        _draw_bands(left, tests, "bending_length")
        _draw_bands(right, tests, "drape_coefficient")
        figure.suptitle(title, x=0.015, ha="left", fontsize=10.5, weight="bold", color=TEXT_COLOUR)
        figure.supxlabel("bar: published band; point: simulated", x=0.015, ha="left", fontsize=7.5, color=MUTED_COLOUR)
        figure.savefig(path, format="png")
        plt.close(figure)


def is_in_band(measured: Mapping[str, float]) -> bool:
    """Return whether a measured value lies in its published band."""
    return measured["low"] <= measured["value"] <= measured["high"]


def _draw_forms(figure: Any, forms: Sequence[dict[str, Any]]) -> None:
    """Draw a panel for each closed form: relative error and what explains it, by level."""
    columns = 4
    for k, row in enumerate(forms):
        width = 0.94 / columns
        left, bottom = 0.05 + (k % columns) * width, 0.66 - (k // columns) * 0.27
        axes = figure.add_axes((left, bottom, 0.74 * width, 0.165))
        scale = abs(row["exact"]) or 1.0
        floor = 1e-11
        errors = np.maximum(np.array(row["errors"]) / scale, floor)
        levels = np.array(row["levels"], float)
        is_good = row["verdict"] == "confirmed"
        axes.plot(levels, errors, "-o", color=FASTER_COLOUR if is_good else WARNING_COLOUR, markersize=5)
        if row["observed_order"] is not None:
            expected = errors[-1] * (levels[-1] / levels) ** row["order"]
            axes.plot(levels, expected, ":", color=MUTED_COLOUR, linewidth=1.2, zorder=0)
        axes.plot(levels[-1:], [max(row["explained_error"] / scale, floor)], "_", color=TEXT_COLOUR, markersize=14)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.set_ylim(10 ** (np.floor(np.log10(errors.min())) - 0.3), 10 ** (np.ceil(np.log10(errors.max())) + 0.3))
        axes.set_xticks(levels, [f"{level:g}" for level in levels])
        axes.minorticks_off()
        axes.grid(axis="y")
        axes.tick_params(labelsize=8)
        title = row["name"] if row["exact"] else f"{row['name']}: error [m]"
        axes.set_title(title, fontsize=10, loc="left", color=TEXT_COLOUR)
        axes.set_xlabel("steps" if row["refined"] == "time step" else row["refined"], fontsize=8)
    figure.text(
        0.05, 0.025, "relative error by refinement; dotted: the order of the method; dash: the error that is explained",
        fontsize=9, color=MUTED_COLOUR,
    )  # fmt: skip


def _draw_bands(axes: Any, tests: Sequence[dict[str, Any]], key: str) -> None:
    """Draw simulated values as points on their published bands."""
    factor, title = (1e3, "bending length [mm]") if key == "bending_length" else (1.0, "drape coefficient [%]")
    for k, row in enumerate(reversed(tests)):
        band = {name: factor * value for name, value in row[key].items()}
        axes.plot([band["low"], band["high"]], [k, k], color=RULE_COLOUR, linewidth=7, solid_capstyle="butt")
        colour = FASTER_COLOUR if is_in_band(band) else WARNING_COLOUR
        axes.plot(band["value"], k, "o" if is_in_band(band) else "D", color=colour, markersize=5)
    axes.set_yticks(range(len(tests)), [row["name"].removeprefix("fabric ") for row in reversed(tests)])
    axes.set_ylim(-0.6, len(tests) - 0.4)
    axes.set_xlim(left=0.0)
    axes.set_xlabel(title)


CLOSED_FORMS_PICTURE, FABRICS_PICTURE = "closed-forms.png", "fabrics.png"
_PICTURES = {CLOSED_FORMS_PICTURE: draw_closed_forms, FABRICS_PICTURE: draw_fabrics}
"""Function that draws each picture."""
