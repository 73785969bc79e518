"""What a sweep's runs say, in sentences: who is fastest where all are equally accurate, and who is far from it.

Runs are compared by their least times, as at the end of a sweep: these depend least on what else the machine does.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

from harness.report.learned import SAME
from harness.report.page import factor, quantity

Run = dict[str, Any]


def sentences(found: Sequence[Run]) -> list[dict[str, Any]]:
    """Sentences, each with the ids of its runs: of each scene the largest size that several runs did."""
    told = [said for group in _races(found) for said in _race(group)]
    return told + list(_unconverged(found))


def _races(found: Sequence[Run]) -> Iterator[list[Run]]:
    """Of each scene the runs of its largest size of which there are several that ended well and were timed."""
    groups: dict[str, dict[Any, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in found:
        if run["status"] == "ok" and run["least"] is not None:
            groups[run["scene"]][run["size"] or 0, run["integrator"], run["time_step"]].append(run)
    for sizes in groups.values():
        several = [key for key, group in sizes.items() if len({run["label"] for run in group}) > 1]
        if several:
            yield sizes[max(several)]


def _race(group: Sequence[Run]) -> Iterator[dict[str, Any]]:
    where = f"{group[0]['scene']}{' ' + str(group[0]['size']) if group[0]['size'] else ''}"
    known = [run for run in group if run["residual"] is not None]
    lowest = min((run["residual"] for run in known), default=None)
    equal = [run for run in known if lowest is not None and run["residual"] <= SAME * lowest] or list(group)
    first, *others = sorted(equal, key=lambda run: run["least"])
    words = f"{where}: fastest at equal accuracy is {first['label']}, {quantity(first['least'])} ms a step at the least"
    if others:
        words += "; " + ", ".join(f"{run['label']} takes {_times(run, first)}" for run in others[:4])
    yield {"words": f"{words}.", "runs": [first["run_id"], *(run["run_id"] for run in others[:3])]}
    worse = [run for run in known if run not in equal and run["least"] < first["least"]]
    for run in sorted(worse, key=lambda run: run["least"])[:2]:
        far = factor(run["residual"] / lowest) if lowest else "many"
        words = f"{where}: {run['label']} is faster, {quantity(run['least'])} ms, and ends {far} times further away."
        yield {"words": words, "runs": [run["run_id"], first["run_id"]]}


def _times(run: Run, first: Run) -> str:
    return f"{factor(run['least'] / first['least'])} times as long"


def _unconverged(found: Sequence[Run]) -> Iterator[dict[str, Any]]:
    """How many runs ended their steps by the limit of iterations and not by what they reached."""
    done = [run for run in found if run["status"] == "ok" and run["stopped"]]
    short = [run for run in done if run["stopped"] == "iterations"]
    if short:
        words = f"{len(short)} of {len(done)} runs ended their last step at the limit of iterations: look at residuals."
        yield {"words": words, "runs": [short[0]["run_id"]], "filter": {"stopped": "iterations"}}
