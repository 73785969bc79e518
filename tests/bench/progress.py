"""Compare the remaining times that a command prints with the time at which it ends.

    python -m tests.bench.progress reproduce hard --quick --seed 1

The arguments are those of `springbench`. All lines of its output are printed with the seconds since the start. At the
end the wrong estimates of the second half are listed: those that differ from the true remaining time by more than a
factor of MAX_FACTOR and by more than MIN_SHARE of the total time. The exit code is 1 if there are any.
"""

from __future__ import annotations

import re
import subprocess
import sys
from time import perf_counter

MAX_FACTOR = 2.0
"""Accepted factor between an estimate and the true remaining time, in the second half of the total time."""
MIN_SHARE = 0.1
"""Accepted difference as a share of the total time: near the end a single run determines the remaining time."""

_ESTIMATE = re.compile(r"about (\d+) (s|min) left")


def is_estimate_wrong(estimate: float, elapsed: float, total: float) -> bool:
    """Return whether an estimate of the remaining time of a command was wrong.

    Args:
        estimate: remaining time that was printed [s].
        elapsed: time since the start [s].
        total: time from start to end [s].
    """
    left = total - elapsed
    if elapsed < 0.5 * total or abs(estimate - left) <= MIN_SHARE * total:
        return False
    return not left / MAX_FACTOR <= estimate <= left * MAX_FACTOR


def record_estimates(arguments: list[str]) -> tuple[list[tuple[float, float]], float]:
    """Run `springbench`, and return its estimates as (elapsed, estimate) [s], and the total time [s]."""
    start, found = perf_counter(), list[tuple[float, float]]()
    command = [sys.executable, "-u", "-m", "springbench", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout
        for line in process.stdout:
            elapsed = perf_counter() - start
            print(f"{elapsed:8.1f} s  {line}", end="", flush=True)
            if match := _ESTIMATE.search(line):
                found.append((elapsed, float(match[1]) * (60.0 if match[2] == "min" else 1.0)))
    return found, perf_counter() - start


def main() -> None:
    """Run the command of the command line, and print its wrong estimates."""
    estimates, total = record_estimates(sys.argv[1:])
    wrong = [one for one in estimates if is_estimate_wrong(one[1], one[0], total)]
    late = sum(elapsed >= 0.5 * total for elapsed, _ in estimates)
    print(f"{total:.0f} s; {len(estimates)} estimates, {late} of them in the second half, {len(wrong)} wrong")
    for elapsed, estimate in wrong:
        print(f"after {elapsed:.0f} s {estimate:.0f} s were stated, {total - elapsed:.0f} s were left")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
