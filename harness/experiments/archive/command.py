"""Commands of `springbench` on existing results: compact, merge, publish, verify."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from harness.base import places
from harness.base.console import say
from harness.base.errors import InputError, Mistake

_FOLDER: Any = {"parser": places.parse, "metavar": "PATH|URL", "help": "A folder of results, or that of one sweep."}
Folder = Annotated[Path, typer.Argument(callback=places.everything, **_FOLDER)]


def compact(
    results: Folder,
    days: Annotated[float, typer.Option(help="Pack what was written so many days ago or more; 0 is all.")] = 0.0,
) -> None:
    """Pack the rows of many runs into one file.

    All commands read the same rows before and after.
    """
    from harness.experiments.archive.compact import compact as pack

    if not 0.0 <= days < 1e6:
        raise InputError(Mistake(f"came {days:g}; wanted a number of days, 0 or more", key="--days"))
    pack(results, say, days=days)


def merge(
    sources: Annotated[list[Path], typer.Argument(help="Folders of results, or those of sweeps.")],
    into: Annotated[Path, typer.Option("-o", "--into", help="The folder that has all of them afterwards.")],
) -> None:
    """Merge folders of results.

    Exit code 1: runs of one machine and source code ended at different positions.
    """
    from harness.experiments.archive.merge import merge as bring_together

    found = bring_together(sources, into, say)
    say(f"{found.written} units of rows written, {found.known} were there")
    for line in found.conflicts:
        say(f"conflict, on one machine and by one code: {line} positions differ")
    for line in [line for line in found.others if line not in found.conflicts]:
        say(f"differs between machines or codes: {line}")
    for line in found.machines:
        say(line)
    raise typer.Exit(1 if found.conflicts else 0)


def publish(
    results: Folder,
    output: Annotated[Path, typer.Option("-o", "--output", help="The archive to write (.zip).")],
    license: Annotated[str, typer.Option(help="What others may do with it: a name or a URL.")] = "",
) -> None:
    """Write results, their configs and checksums to one archive.

    Others can cite and verify it.
    """
    from harness.experiments.archive.publish import publish as put_together

    count = put_together(results, output, say, license=license)
    say(f"{output} holds {count} files; `springbench verify {output}` does a tenth of its runs again")


def verify(
    archive: Annotated[Path, typer.Argument(help="What `springbench publish` wrote (.zip).")],
    seed: Annotated[int | None, typer.Option(help="Chooses the runs; another each time if left out.")] = None,
    own_code: Annotated[
        bool, typer.Option("--own-code", help="Do also runs that need code from the archive: read it first.")
    ] = False,
) -> None:
    """Verify the checksums of an archive, and repeat a random tenth of its runs.

    Exit code 1: a claim fails; 3: a claim is inconclusive.
    """
    from secrets import randbelow
    from tempfile import TemporaryDirectory

    from harness.base.console import err
    from harness.base.progress import display
    from harness.experiments.archive import verify as checks

    with checks.unpacked(archive) as folder, TemporaryDirectory() as scratch:
        if wrong := checks.checksums(folder):
            for claim in wrong:
                say(str(claim))
            say(f"{archive} is not what was published; nothing of it was run")
            raise typer.Exit(1)
        say("all checksums hold")
        found, claims = checks.published(folder, say, own_code=own_code)
        runs = checks.possible(found, say)
        chance = randbelow(10**6) if seed is None else seed
        taken = checks.chosen(runs, chance)
        say(f"{len(taken)} of {len(runs)} runs are done again (--seed {chance})")
        claims += checks.compare(taken, checks.again(taken, Path(scratch), display(err())))
    for claim in claims:
        say(str(claim))
    say(f"no repeat confirms these columns: {', '.join(sorted(checks.UNREPEATED))}")
    states = {claim.holds for claim in claims}
    bad, unknown = checks.Holds.NO in states, checks.Holds.UNKNOWN in states or not claims
    say(
        "something does not hold" if bad else "not all can be told here" if unknown else "all that was done again holds"
    )
    raise typer.Exit(1 if bad else 3 if unknown else 0)
