# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Picture of the sparsity patterns of several matrices, with their numbers of stored entries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.ticker import MaxNLocator
from scipy.sparse import coo_array, csr_array
from springbench.harness.report.page_layout import add_axes, draw_header, draw_text, new_page, save_page
from springbench.harness.report.plot_style import MUTED_COLOUR, PAGE_RC, PAGE_WIDTH, TEXT_COLOUR

_LEFT, _TOP, _GAP, _BOTTOM = 84, 178, 84, 84
_MAX_HEIGHT, _MIN_WIDTH = 640, 90
"""Largest height and smallest width of a panel [pixels]."""
_POSITIVE_COLOUR, _NEGATIVE_COLOUR = TEXT_COLOUR, "#d55e00"
_MIN_MARKER, _MAX_MARKER = 0.4, 11.0
"""Limits of the side of an entry [points]."""


def draw_sparsity(matrices: Mapping[str, csr_array], path: Path, title: str, facts: Sequence[str]) -> Path:
    """Draw the patterns at one scale as a PNG file.

    Positive entries are dark, negative ones orange.

    Args:
        matrices: matrices by name, in drawing order.
        path: target file.
        title: title of the picture.
        facts: phrases below the title.

    Returns:
        The path.
    """
    shapes = np.array([matrix.shape for matrix in matrices.values()], float)
    across = PAGE_WIDTH - 2 * _LEFT - _GAP * (len(shapes) - 1)
    scale = min(_MAX_HEIGHT / shapes[:, 0].max(), across / shapes[:, 1].sum())
    with matplotlib.rc_context(PAGE_RC):
        page = new_page()
        draw_header(page, title, facts)
        x = float(_LEFT)
        for name, matrix in matrices.items():
            rows, columns = matrix.shape
            width, height = max(_MIN_WIDTH, scale * columns), max(12.0, scale * rows)
            axes = add_axes(page, x, _TOP, width, height)
            entries = coo_array(matrix)
            side = float(np.clip(0.62 * min(width / columns, height / rows), _MIN_MARKER, _MAX_MARKER))
            for chosen, colour in (
                (entries.data >= 0, _POSITIVE_COLOUR),
                (entries.data < 0, _NEGATIVE_COLOUR),
            ):
                axes.plot(
                    entries.coords[1][chosen],
                    entries.coords[0][chosen],
                    "s",
                    color=colour,
                    markersize=side,
                    markeredgewidth=0,
                )
            axes.set_xlim(-0.5, columns - 0.5)
            axes.set_ylim(rows - 0.5, -0.5)
            for axis, extent in ((axes.xaxis, width), (axes.yaxis, height)):
                axis.set_major_locator(MaxNLocator(nbins=max(1, int(extent // 70)), integer=True))
            for spine in axes.spines.values():
                spine.set_visible(True)
            draw_text(page, x, _TOP - 30, name, size=15, weight="bold")
            draw_text(page, x, _TOP - 10, f"{rows} x {columns}, {matrix.nnz:,} entries", size=9.5, color=MUTED_COLOUR)
            x += width + _GAP
        save_page(page, path, used_height=_TOP + max(12.0, scale * shapes[:, 0].max()) + _BOTTOM)
    return path
