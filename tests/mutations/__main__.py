"""The command line: plants errors, reports which tests catch them, and stores the outcomes."""

from __future__ import annotations

import argparse
import random
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

from tests.mutations import runner
from tests.mutations.base import ROOT, Mutation, StaleMutation
from tests.mutations.planted import TABLE
from tests.mutations.runner import Outcome, SourceCopy


def parse_arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description="Plants errors and runs tests.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="errors to plant (default: all)")
    parser.add_argument("--again", action="store_true", help="also those whose outcome is known")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="how many at once (2)")
    parser.add_argument("--whole", type=int, default=0, metavar="N", help="N of them, with all tests instead")
    options = parser.parse_args()
    unknown = set(options.names) - {mutation.name for mutation in TABLE}
    if unknown:
        names = ", ".join(mutation.name for mutation in TABLE)
        parser.error(f"no planted error has the name {', '.join(sorted(unknown))}; the names are {names}")
    if options.jobs < 1 or not 0 <= options.whole <= len(TABLE):
        parser.error(f"--jobs should be at least 1, and --whole from 0 to {len(TABLE)}")
    return options


def main() -> int:
    """Plant the errors. Exit code 0 if all are caught, 1 if one is not, 2 if the table does not fit the sources, 3 if a
    time-out or skipped tests leave one undecided."""
    options = parse_arguments()
    chosen = [mutation for mutation in TABLE if not options.names or mutation.name in options.names]
    if options.whole:
        chosen = random.Random(0).sample(chosen, min(options.whole, len(chosen)))
    try:
        for mutation in chosen:
            mutation.apply(ROOT)
    except StaleMutation as error:
        print(error, file=sys.stderr)
        return 2
    whole = bool(options.whole)
    suffix = " whole" if whole else ""
    stored = runner.read_outcomes()

    def is_known(mutation: Mutation) -> bool:
        known = stored.get(mutation.name + suffix)
        digests = (mutation.digest, runner.digest_sources(mutation, whole=whole))
        return bool(known and known.is_decided and (known.entry, known.sources) == digests and not options.again)

    def last_seconds(mutation: Mutation) -> float:
        known = stored.get(mutation.name + suffix)
        return known.seconds if known else 0.0

    outcomes = [stored[mutation.name + suffix] for mutation in chosen if is_known(mutation)]
    missing = sorted((mutation for mutation in chosen if not is_known(mutation)), key=last_seconds)
    if outcomes:
        print(f"{len(outcomes)} of {len(chosen)} are known already")
    with TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as workers:
        digests = {mutation.name: runner.digest_sources(mutation, whole=whole) for mutation in missing}
        copies: SimpleQueue[SourceCopy] = SimpleQueue()
        for job in range(options.jobs):
            copies.put(SourceCopy(Path(folder) / str(job)))

        def examine_next(mutation: Mutation) -> Outcome:
            copy, known = copies.get(), stored.get(mutation.name)
            before = known.failed if known else ""
            try:
                return runner.examine(copy, mutation, digests[mutation.name], whole=whole, failed_before=before)
            finally:
                copies.put(copy)

        for outcome in workers.map(examine_next, missing):
            runner.store_outcome(outcome.name + suffix, outcome)
            outcomes.append(outcome)
            product = f", by the product {outcome.product}" if outcome.product else ""
            print(f"{outcome.name}: {outcome.tests}{product} ({outcome.seconds:.0f} s) {outcome.failed}", flush=True)
    return summarise_outcomes(outcomes)


def summarise_outcomes(outcomes: list[Outcome]) -> int:
    """Print how many are caught, and which are not. Returns the exit code."""
    undecided = [outcome.name for outcome in outcomes if not outcome.is_decided]
    missed = [outcome.name for outcome in outcomes if outcome.is_decided and not outcome.is_caught]
    print(
        f"{sum(outcome.is_caught for outcome in outcomes)} of {len(outcomes)} caught"
        + (f"; not caught: {', '.join(missed)}" if missed else "")
        + (f"; undecided, run again: {', '.join(undecided)}" if undecided else "")
    )
    return 1 if missed else 3 if undecided else 0


if __name__ == "__main__":
    sys.exit(main())
