# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Labels at the ends of lines, moved apart where lines end close together."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes

LINE = 17
"""Distance between labels [pixels]."""

End = tuple[float, float, str, str]
"""The end of a line in data coordinates, its label and its colour."""


def direct_labels(ax: Axes, ends: Sequence[End]) -> None:
    """Draw labels to the right of the lines' ends.

    Labels that would overlap are moved apart.

    Args:
        ax: axes of the lines.
        ends: line ends with label and colour.
    """
    for column in sorted({x for x, *_ in ends}):
        here = sorted((end for end in ends if end[0] == column), key=lambda end: end[1])
        wanted = ax.transData.transform([(x, y) for x, y, *_ in here])
        at = spread(wanted[:, 1].tolist(), ax.bbox.y0 + 6, ax.bbox.y1 - 6)
        for (x, y, words, color), height in zip(here, at, strict=True):
            # In fractions of the figure, because pixels have another meaning in vector formats.
            x_share, y_share = ax.figure.transFigure.inverted().transform((wanted[0, 0] + 16, height))
            line = {"arrowstyle": "-", "color": color, "alpha": 0.45, "linewidth": 0.8, "shrinkA": 1, "shrinkB": 5}
            ax.annotate(
                words,
                (x, y),
                (x_share, y_share),
                textcoords="figure fraction",
                va="center",
                fontsize=9.5,
                color=color,
                arrowprops=line,
            )


def spread(wanted: Sequence[float], bottom: float, top: float) -> list[float]:
    """Return sorted heights [pixels] that are at least LINE apart.

    They are moved up from below, then down from the top.

    Args:
        wanted: preferred heights, ascending [pixels].
        bottom: lower limit [pixels].
        top: upper limit [pixels].
    """
    at = list(wanted)
    for k in range(1, len(at)):
        at[k] = max(at[k], at[k - 1] + LINE)
    at[-1] = min(at[-1], top)
    for k in reversed(range(len(at) - 1)):
        at[k] = max(min(at[k], at[k + 1] - LINE), bottom)
    return at
