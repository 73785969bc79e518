"""The command line: plants lies, says who found them out, and keeps what it has found."""

from __future__ import annotations

import argparse
import random
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

from tests.mutations import runner
from tests.mutations.base import ROOT, Mutation, Stale
from tests.mutations.planted import TABLE
from tests.mutations.runner import Copy, Outcome, examine


def arguments() -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description="Plants lies and runs tests.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="lies to plant; all where none is named")
    parser.add_argument("--again", action="store_true", help="also those whose outcome is known")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="how many at once (2)")
    parser.add_argument("--whole", type=int, default=0, metavar="N", help="N of them, with all tests instead")
    options = parser.parse_args()
    unknown = set(options.names) - {lie.name for lie in TABLE}
    if unknown:
        parser.error(f"there is no lie {', '.join(sorted(unknown))}; there are {', '.join(lie.name for lie in TABLE)}")
    if options.jobs < 1 or not 0 <= options.whole <= len(TABLE):
        parser.error(f"--jobs should be at least 1, and --whole from 0 to {len(TABLE)}")
    return options


def main() -> int:
    """Exit code 0 where all were found out, 1 where not, 2 where the sources do not fit the table any more."""
    options = arguments()
    chosen = [lie for lie in TABLE if not options.names or lie.name in options.names]
    if options.whole:
        chosen = random.Random(0).sample(chosen, min(options.whole, len(chosen)))
    try:
        for lie in chosen:
            lie.applied(ROOT)
    except Stale as error:
        print(error, file=sys.stderr)
        return 2
    suffix = " whole" if options.whole else ""
    today, saved = runner.sources(), runner.known()

    def done(lie: Mutation) -> bool:
        found = saved.get(lie.name + suffix)
        return bool(found and (found.entry, found.sources) == (lie.digest, today) and not options.again)

    outcomes = [saved[lie.name + suffix] for lie in chosen if done(lie)]
    if outcomes:
        print(f"{len(outcomes)} of {len(chosen)} are known already")
    with TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as workers:
        copies: SimpleQueue[Copy] = SimpleQueue()
        for job in range(options.jobs):
            copies.put(Copy(Path(folder) / str(job)))

        def one(lie: Mutation) -> Outcome:
            copy = copies.get()
            try:
                return examine(copy, lie, whole=bool(options.whole))
            finally:
                copies.put(copy)

        for outcome in workers.map(one, [lie for lie in chosen if not done(lie)]):
            runner.keep(outcome.name + suffix, outcome)
            outcomes.append(outcome)
            product = f", by the product {outcome.product}" if outcome.product else ""
            print(f"{outcome.name}: {outcome.tests}{product} ({outcome.seconds:.0f} s) {outcome.failed}", flush=True)
    left = [outcome.name for outcome in outcomes if not outcome.found_out]
    print(f"{len(outcomes) - len(left)} of {len(outcomes)} found out" + (f"; not: {', '.join(left)}" if left else ""))
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
