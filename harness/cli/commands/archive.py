"""Commands of `springbench` on existing results: compact, merge, publish, verify."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from springbench.harness.cli import results_location
from springbench.harness.console import print_message
from springbench.harness.errors import InputError, InputMistake

_FOLDER_ARGUMENT: Any = {
    "parser": results_location.parse_location,
    "metavar": "PATH|URL",
    "help": "A folder of results, or that of one sweep.",
}
ResultsFolder = Annotated[Path, typer.Argument(callback=results_location.sync_results, **_FOLDER_ARGUMENT)]


def compact(
    results: ResultsFolder,
    min_age_days: Annotated[float, typer.Option(help="Minimum age of packed rows [days]; 0 packs all.")] = 0.0,
) -> None:
    """Pack the rows of many runs into one file.

    All commands read the same rows before and after.
    """
    from springbench.harness.experiments.archive.compaction import compact_results as pack

    if not 0.0 <= min_age_days < 1e6:
        raise InputError(
            InputMistake(f"got {min_age_days:g}; expected a number of days, 0 or more", key="--min-age-days")
        )
    pack(results, print_message, min_age_days=min_age_days)


def merge(
    sources: Annotated[list[Path], typer.Argument(help="Folders of results or of sweeps.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the merged results.")],
) -> None:
    """Merge folders of results.

    Exit code 1: runs of one machine and source code ended at different positions.
    """
    from springbench.harness.experiments.archive.result_merge import merge_results as bring_together

    found = bring_together(sources, output, print_message)
    print_message(f"{found.num_written} units of rows written, {found.num_existing} were there")
    for line in found.conflicts:
        print_message(f"conflict, on one machine and by one code: {line} positions differ")
    for line in [line for line in found.cross_machine_differences if line not in found.conflicts]:
        print_message(f"differs between machines or codes: {line}")
    for line in found.machine_summary:
        print_message(line)
    raise typer.Exit(1 if found.conflicts else 0)


def publish(
    results: ResultsFolder,
    output: Annotated[Path, typer.Option("-o", "--output", help="Archive to write (.zip).")],
    license: Annotated[str, typer.Option(help="License: a name or a URL.")] = "",
) -> None:
    """Write results, their configs and checksums to one archive.

    Others can cite and verify it.
    """
    from springbench.harness.experiments.archive.publication import publish_results as put_together

    count = put_together(results, output, print_message, license_text=license)
    print_message(
        f"{output} contains {count} files; `springbench verify-archive {output}` does a tenth of its runs again"
    )


def verify_archive(
    archive: Annotated[Path, typer.Argument(help="Archive of `springbench publish` (.zip).")],
    seed: Annotated[int | None, typer.Option(help="Seed that selects the runs; random by default.")] = None,
    with_user_code: Annotated[
        bool,
        typer.Option("--with-user-code", help="Also repeat runs that execute code from the archive; review it first."),
    ] = False,
) -> None:
    """Verify the checksums of an archive, and repeat a random tenth of its runs.

    Exit code 1: a claim fails; 3: a claim is inconclusive.
    """
    raise typer.Exit(verify_one_archive(archive, seed, with_user_code=with_user_code))


def verify_one_archive(archive: Path, seed: int | None, *, with_user_code: bool) -> int:
    """Verify an archive, and print a verdict on each claim.

    Args:
        archive: file (.zip) of `springbench publish`.
        seed: seed that selects the runs to repeat; random if None.
        with_user_code: whether to repeat runs that execute code from the archive.

    Returns:
        Exit code of `verify-archive`: 0 if all claims are confirmed, 1 if one is refuted, 3 if one is undecided.

    Raises:
        InputError: the archive is damaged or too large.
    """
    from secrets import randbelow
    from tempfile import TemporaryDirectory

    from springbench.harness.console import get_error_console
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.archive import archive_verification as checks
    from springbench.harness.experiments.archive.archive_unpacking import unpack_archive

    with unpack_archive(archive) as folder, TemporaryDirectory() as scratch:
        if wrong := checks.verify_checksums(folder):
            for claim in wrong:
                print_message(str(claim))
            print_message(f"{archive} differs from its checksums; no run was repeated")
            return 1
        print_message("all checksums match")
        found, claims = checks.load_published_runs(folder, print_message, with_user_code=with_user_code)
        runs = checks.select_runnable(found, print_message)
        chance = randbelow(10**6) if seed is None else seed
        taken = checks.sample_runs(runs, chance)
        print_message(f"repeating {len(taken)} of {len(runs)} runs (--seed {chance})")
        claims += checks.verify_reruns(
            taken, checks.rerun_published(taken, Path(scratch), create_display(get_error_console()))
        )
    for claim in claims:
        print_message(str(claim))
    unconfirmed = ", ".join(sorted(checks.IRREPRODUCIBLE_COLUMNS))
    print_message(f"columns that a repeated run cannot confirm: {unconfirmed}, and the times in solver_phases")
    states = {claim.verdict for claim in claims}
    bad, unknown = checks.ClaimVerdict.FAIL in states, checks.ClaimVerdict.INCONCLUSIVE in states or not claims
    print_message(
        "a claim is refuted"
        if bad
        else "some claims cannot be decided on this machine"
        if unknown
        else "all repeated runs confirm the claims"
    )
    return 1 if bad else 3 if unknown else 0
