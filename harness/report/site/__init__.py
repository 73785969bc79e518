"""The page of all results: one `index.html` that a browser opens from the file system, without network or server.

    index.html                     beside the folders of the sweeps, or in that of one sweep
    site/*.js, *.css               the page's own scripts and its style; plotly.js, loaded when a plot is asked for
    site/data/index.js             which sweeps there are: all that the first view shows
    site/data/<sweep>/runs.js      the table of its runs; <chart>.js, runs/<run id>.js and so on: loaded when asked for

    site/viewer.js                 Rerun's web viewer, if `springbench report` put it there: loaded for a recording

Data are scripts, since a page from the file system may load nothing else: each calls `springbench.give(name, value)`.
"""

from __future__ import annotations

from harness.report.site.build import keep, update

__all__ = ["keep", "update"]
