"""Templates of the scripts that reproduce figures.

A script consists of a common header and the code for curves, cell maps or meshes.
"""

SCRIPT_HEADER = '''"""Draws {name} again from {name}.csv, for you to change; needs Python with matplotlib alone."""

import csv
from pathlib import Path

import matplotlib.pyplot as plt

HERE = Path(__file__).parent


def rows(name):
    """Return the rows of a CSV file next to this script, without its comments."""
    with open(HERE / name, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


plt.rcParams.update({{"font.size": {size}, "xtick.labelsize": {small}, "ytick.labelsize": {small}}})
plt.rcParams.update({{"axes.titlesize": {small}, "axes.labelsize": {small}, "legend.fontsize": {small}}})
plt.rcParams.update({{"pdf.fonttype": 42, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.5}})
'''

CURVE_TEMPLATE = """
# Colour, marker and line style of each curve.
LOOKS = {looks}
PANELS = {panels}

data = rows("{name}.csv")
figure, axes = plt.subplots({rows}, {columns}, figsize={inches}, layout="constrained", squeeze=False)
for ax in axes.flat[len(PANELS) :]:
    ax.set_axis_off()
for ax, (panel, how) in zip(axes.flat, PANELS.items()):
    for (label, setting), curve in how["curves"].items():
        color, marker, dash = LOOKS[label]
        mine = [row for row in data if (row["panel"], row["series"], row["setting"]) == (panel, label, setting)]
        x, y, low, high = ([float(row[key]) for row in mine] for key in ("x", "y", "lower", "upper"))
        style = {{"drawstyle": "steps-post"}} if curve["is_stepped"] else {{}}
        ax.plot(x, y, color=color, linestyle=dash if curve["is_connected"] else "none", linewidth=1.1, **style)
        face = ["white" if row["is_stale"] == "True" else color for row in mine]
        if len(mine) <= 12 and not curve["is_stepped"]:  # more marks hide the curve, and a step is no measurement
            ax.scatter(x, y, 13, marker=marker, facecolors=face, edgecolors=color, linewidths=0.8, zorder=3)
        if curve["is_horizontal"]:
            ax.hlines(y, low, high, color=color, alpha=0.4)
        else:
            ax.vlines(x, low, high, color=color, alpha=0.4)
    for label, (color, marker, dash) in LOOKS.items():
        ax.plot([], [], color=color, marker=marker, linestyle=dash, markersize=3.6, label=label)
    for y in how["lines"]:
        ax.axhline(y, color="gray", linewidth=0.6, linestyle="--")
    for x in how["x_lines"]:
        ax.axvline(x, color="gray", linewidth=0.6, linestyle="--")
    ax.set(title=how["title"], xlabel=how["x"]["words"], ylabel=how["y"]["words"])
    ax.set(xscale=how["x"]["scale"], yscale=how["y"]["scale"])
    if how["x"]["names"]:
        ax.set_xticks(range(len(how["x"]["names"])), how["x"]["names"])
    if how["y"]["names"]:
        ax.set_yticks(range(len(how["y"]["names"])), how["y"]["names"])
        ax.invert_yaxis()
handles, labels = axes.flat[0].get_legend_handles_labels()
figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False)
figure.savefig(HERE / "{name}-again.pdf")
"""

CELL_MAP_TEMPLATE = """
OUTCOMES = {outcomes}

data = rows("{name}.csv")
panels = list(dict.fromkeys(row["panel"] for row in data))
figure, axes = plt.subplots({rows}, {columns}, figsize={inches}, layout="constrained", squeeze=False)
for ax, panel in zip(axes.flat, panels):
    mine = [row for row in data if row["panel"] == panel]
    down, across = (list(dict.fromkeys(row[key] for row in mine)) for key in ("row", "column"))
    for row in mine:
        at = across.index(row["column"]), down.index(row["row"])
        ax.add_patch(plt.Rectangle((at[0] + 0.04, at[1] + 0.06), 0.92, 0.88, color=row["color"]))
        if row["is_stale"] == "True":
            ax.plot(at[0] + 0.12, at[1] + 0.24, "o", color="black", markerfacecolor="white", markersize=2.6)
    ax.set(xlim=(0, len(across)), ylim=(len(down), 0))
    ax.set_xticks([k + 0.5 for k in range(len(across))], across, rotation=90)
    ax.set_yticks([k + 0.5 for k in range(len(down))], down)
    ax.tick_params(length=0, labeltop=True, labelbottom=False)
used = {{row["outcome"] for row in data}}
patches = [plt.Rectangle((0, 0), 1, 1, color=color, label=name) for name, color in OUTCOMES.items() if name in used]
figure.legend(handles=patches, loc="outside lower left", ncols=3, frameon=False)
figure.savefig(HERE / "{name}-again.pdf")
"""

MESH_TEMPLATE = """
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # noqa: E402

TITLES = {titles}
LIMIT = {limit}

vertices, mesh = rows("{name}.csv"), rows("{name}-mesh.csv")
figure = plt.figure(figsize={inches}, layout="constrained")
colours = plt.cm.ScalarMappable(plt.Normalize(-LIMIT, LIMIT), "coolwarm")
axes = []
for k, (panel, title) in enumerate(TITLES.items()):
    ax = figure.add_subplot({rows}, {columns}, k + 1, projection="3d", title=title)
    mine = [row for row in vertices if row["panel"] == panel]
    # The height is y in the CSV file and z in matplotlib.
    p = [(float(row["x"]), -float(row["z"]), float(row["y"])) for row in mine]
    strain = [float(row["strain"]) for row in mine]
    parts = [[int(row[key]) for key in "abc" if row.get(key)] for row in mesh if row["panel"] == panel]
    kind = Poly3DCollection if len(parts[0]) == 3 else Line3DCollection
    faces = kind([[p[i] for i in part] for part in parts], linewidths=0.2)
    shade = colours.to_rgba([sum(strain[i] for i in part) / len(part) for part in parts])
    faces.set(facecolor=shade) if len(parts[0]) == 3 else faces.set(color=shade)
    ax.add_collection3d(faces)
    ax.auto_scale_xyz(*zip(*p))
    ax.set_box_aspect([max(max(side) - min(side), 1e-9) for side in zip(*p)])
    ax.view_init(elev=15, azim=-60)
    ax.set_axis_off()
    axes.append(ax)
figure.colorbar(colours, ax=axes, location="bottom", shrink=0.6, label="strain")
figure.savefig(HERE / "{name}-again.pdf")
"""
