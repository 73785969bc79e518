"""Planted errors in what tables, pictures, figures and the page state of runs."""

from __future__ import annotations

from tests.mutations.base import Mutation

_QUANTITIES = "harness/results/quantities.py"
_QUANTITY_TESTS, _TIMES = "tests/unit/test_quantities.py", "tests/unit/test_report_timing.py"
_PAGE, _SITE, _ROWS = "tests/contracts/test_page.py", "tests/unit/test_site.py", "tests/contracts/test_hostile_rows.py"
_STATIC = "harness/report/site/static"

PAGE = (
    Mutation(
        "picture-distance-mean",
        "harness/report/comparison_picture.py",
        "np.linalg.norm(away, axis=1).max(initial=0.0)",
        "np.linalg.norm(away, axis=1).mean()",
        (_QUANTITY_TESTS,),
    ),
    Mutation(
        "ablation-share-of-variant",
        "harness/report/ablation_summary.py",
        '100 * row[key] / whole["seconds"] for key in ("added_seconds"',
        '100 * row[key] / (whole["seconds"] - row["added_seconds"]) for key in ("added_seconds"',
        (_QUANTITY_TESTS,),
    ),
    Mutation(
        "rest-length-median",
        "harness/report/recorded_strain.py",
        "float(replay.rest_lengths.mean())",
        "float(np.median(replay.rest_lengths))",
        (_QUANTITY_TESTS,),
    ),
    Mutation("step-mean-of-rows", _QUANTITIES, "1e3 * median(seconds)", "1e3 * avg(seconds)", (_QUANTITY_TESTS,)),
    Mutation(
        "step-mean-of-recording",
        _QUANTITIES,
        "float(np.median(seconds))",
        "float(np.mean(seconds))",
        (_QUANTITY_TESTS,),
    ),
    Mutation(
        "map-same-5-percent",
        "harness/report/robustness.py",
        "\nSAME_MOTION_DISTANCE = 1e-2\n",
        "\nSAME_MOTION_DISTANCE = 5e-2\n",
        (_QUANTITY_TESTS,),
    ),
    Mutation("strain-of-last-frame", _QUANTITIES, "float(after.max())", "float(after[-1])", (_QUANTITY_TESTS,)),
    Mutation("strain-of-start", _QUANTITIES, "strains[frames > 0]", "strains[frames >= 0]", (_QUANTITY_TESTS,)),
    Mutation(
        "ratio-of-others",
        _QUANTITIES,
        "return run / other",
        "return other / run",
        (_QUANTITY_TESTS,),
    ),
    Mutation(
        "unknown-error-is-equal",
        "harness/report/equal_accuracy.py",
        "errors.get(run.run_id, limit + 1.0) <= limit",
        "errors.get(run.run_id, 0.0) <= limit",
        (_TIMES,),
    ),
    Mutation(
        "figure-of-times-scaled",
        "harness/report/charts/timing_chart.py",
        "else 1e-3 * value for value in milliseconds",
        "else 1e-2 * value for value in milliseconds",
        (_QUANTITY_TESTS,),
    ),
    Mutation(
        "page-frame-longest",
        "harness/report/site/frame_scripts.py",
        "1e3 * median(seconds)",
        "1e3 * max(seconds)",
        (_SITE,),
    ),
    Mutation("page-folder-unescaped", "harness/report/site/sweep_folders.py", "safe=''", "safe=':()'", (_ROWS,)),
    Mutation(
        "page-inherited-names",
        f"{_STATIC}/base.js",
        "Object.hasOwn(object, name)",
        "name in object",
        (f"{_PAGE}::test_every_fragment_shows_something",),
    ),
    Mutation(
        "page-ratio-inverted",
        f"{_STATIC}/compare.js",
        "number(row.step / rows[0].step)",
        "number(rows[0].step / row.step)",
        (_PAGE,),
    ),
)
