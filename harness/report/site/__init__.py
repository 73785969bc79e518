"""The results page: one `index.html` that a browser opens from the file system.

It needs neither network nor server. Its files are:

    index.html                     next to the folders of the sweeps, or in the folder of one sweep
    site/*.js, *.css               scripts and style of the page; plotly.js, loaded when a plot is opened
    site/data/index.js             list of sweeps: all data of the first view
    site/data/<sweep>/runs.js      table of its runs; <chart>.js, runs/<run id>.js and so on: loaded on demand
    site/viewer.js                 Rerun's web viewer, if `springbench report` added it: loaded for a recording

Data files are scripts, because a page from the file system cannot load anything else. Each calls
`springbench.setData(name, value)`; scripts of recordings and of the viewer assign `springbench.scriptContent`.
"""

from __future__ import annotations

from springbench.harness.report.site.page_build import refresh_results_page, update_page

__all__ = ["refresh_results_page", "update_page"]
