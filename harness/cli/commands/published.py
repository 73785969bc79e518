"""Commands on the published set of results: publish-study, reproduce, compare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from springbench.harness.cli.shared_options import ResultsOption
from springbench.harness.console import get_error_console, get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import published_set

if TYPE_CHECKING:
    from springbench.harness.results.study_comparison import RunAgreement

PublishedOption = Annotated[Path, typer.Option(help="Folder of the published set.")]

ALL_STUDIES, ENTRIES = "all", "entries"
"""Names that stand for all studies, and for all contributed archives."""

MAX_ENTRY_BYTES = 2**20
"""Maximum size of a contributed archive [bytes], which is part of every clone."""


def publish_study(
    results: Annotated[
        list[Path],
        typer.Argument(
            help="Results of one config, such as results/hard; or measurements (.parquet). Several: parts of the "
            "study, such as the published one and its missing runs."
        ),
    ],
    config: Annotated[Path | None, typer.Option(help="Config of these results; the owner of the folder.")] = None,
    provenance: Annotated[
        Path | None, typer.Option(help="For measurements: rows (.parquet) of a run by the same machine and code.")
    ] = None,
    omit_times: Annotated[
        bool, typer.Option("--omit-times", help="Leave out all times: a study of outcomes.", show_default=False)
    ] = False,
    published: PublishedOption = published_set.PUBLISHED_FOLDER,
) -> None:
    """Write the results of a study to the published set of this checkout.

    The pages under results/ are made of it, by `springbench pages`.
    """
    from springbench.harness.experiments.archive.study_publication import write_study
    from springbench.harness.results.folder_ownership import read_owner

    owner = config or (read_owner(results[0]) if results[0].is_dir() else None)
    if owner is None:
        raise InputError(InputMistake("does not state its config; give --config", results[0]))
    for path in (*results, provenance):
        if path and not path.exists():
            raise InputError(InputMistake("does not exist; expected results, or a Parquet file of measurements", path))
    write_study(results, owner, published, print_message, provenance, omits_times=omit_times)


def compare(
    results: Annotated[Path, typer.Argument(help="Folder of results, or of one sweep.")],
    published: PublishedOption = published_set.PUBLISHED_FOLDER,
) -> None:
    """Compare runs with the published ones, by ratios to a reference solver."""
    from springbench.harness.report.published_comparison import build_comparison_table, compare_with_published

    if not results.is_dir():
        raise InputError(InputMistake("is no folder; expected results of `springbench run`", results))
    lines = compare_with_published(results, published_set.list_studies(published))
    get_output_console().print(split_wide_table(build_comparison_table(lines), key_columns=3))


def reproduce(
    study: Annotated[str, typer.Argument(help="Name of a published study; all; or entries.")],
    quick: Annotated[bool, typer.Option("--quick", help="Repeat a tenth of the runs, drawn at random.")] = False,
    seed: Annotated[int | None, typer.Option(help="Seed that draws the runs; random by default.")] = None,
    results: ResultsOption = Path("results/reproduced"),
    published: PublishedOption = published_set.PUBLISHED_FOLDER,
    workers: Annotated[int | None, typer.Option(min=1, max=1024, help="Number of worker processes.")] = None,
) -> None:
    """Repeat a published study here, and compare outcomes, iterations, residuals and ratios of times.

    The same command resumes an interrupted repetition. Exit code 1: more results differ than between processors; 3:
    the load of this machine leaves too many ratios of times undecided.
    """
    from secrets import randbelow

    if seed is not None and not quick and study != ENTRIES:
        raise InputError(InputMistake("applies only with --quick; give both", key="--seed"))
    if study == ENTRIES:
        raise typer.Exit(_verify_entries(published / ENTRIES, seed))
    found = published_set.list_studies(published) if study == ALL_STUDIES else ()
    studies = [one for one in found if one.is_repeatable] or [published_set.find_study(published, study)]
    chance = (randbelow(10**6) if seed is None else seed) if quick else None
    durations = [
        (published_set.QUICK_SHARE if quick else 1.0) * (one.metadata["duration_seconds"] or 0.0) for one in studies
    ]
    if len(studies) > 1:
        print_message(f"{len(studies)} studies, which took {_format_duration(sum(durations))} when they were published")
    codes = [_reproduce_one(one, took, results, chance, workers) for one, took in zip(studies, durations, strict=True)]
    raise typer.Exit(_choose_exit_code(codes))


def _reproduce_one(
    study: published_set.PublishedStudy, duration: float, results: Path, seed: int | None, workers: int | None
) -> int:
    """Repeat one study, print what agrees, and return the exit code."""
    if changed := published_set.find_changed_tables(study):
        raise InputError(InputMistake("differs from its checksum in study.json; restore it", changed[0]))
    machine, count = study.metadata["machines"][0], study.metadata["runs"]
    drawn = f"{count} runs" if seed is None else f"a tenth of {count} runs, drawn by --seed {seed}"
    took = f"{_format_duration(duration)} on {machine.get('cpu')}, {machine.get('cores')} cores"
    print_message(f"{study.study_name}: {drawn}; when it was published this took {took}")
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.archive.study_reproduction import reproduce_study

    display = create_display(get_error_console())
    found = reproduce_study(study, results / study.study_name, display, print_message, seed=seed, num_workers=workers)
    return report_agreement(study.study_name, found.runs, found.ratios)


def report_agreement(name: str, runs: Sequence[RunAgreement], ratios: Sequence[RunAgreement]) -> int:
    """Print how many results agree, and all differences.

    Args:
        name: name of the study, for the messages.
        runs: comparisons of repeated runs with the published ones.
        ratios: comparisons of ratios of times; empty for a study without times.

    Returns:
        Exit code: 0 agrees, 1 differs or has no runs, 3 is undecided.
    """
    from springbench.harness.results.study_comparison import MAX_DIFFERING_SHARE, AgreementLevel

    codes = [] if runs else [1]
    for what, found in (("runs", runs), ("ratios of times", ratios)):
        counts = {level: sum(one.level is level for one in found) for level in AgreementLevel}
        for one in found:
            if one.level in (AgreementLevel.DIFFERENT, AgreementLevel.UNDECIDED):
                print_message(f"  {one.title}: {one.explanation}")
        if found:
            stated = [f"{count} {level.value}" for level, count in counts.items() if count]
            print_message(f"{name}: {len(found)} {what}: {', '.join(stated)}")
        limit = MAX_DIFFERING_SHARE * len(found)
        different, undecided = counts[AgreementLevel.DIFFERENT], counts[AgreementLevel.UNDECIDED]
        codes.append(1 if different > limit else 3 if different + undecided > limit else 0)
    code = _choose_exit_code(codes)
    limit = f"at most {100 * MAX_DIFFERING_SHARE:g} % may differ between processors"
    agreement = {
        0: f"agrees with the published results ({limit})",
        1: f"does not agree with the published results ({limit})",
        3: "agrees in what could be compared; repeat the rest on an idle machine",
    }
    print_message(f"{name} {agreement[code]}")
    return code


def _choose_exit_code(codes: Sequence[int]) -> int:
    """Return the least favourable exit code: 1 differs, 3 is undecided, 0 agrees."""
    return next((code for code in (1, 3) if code in codes), 0)


def _format_duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"


def _verify_entries(folder: Path, seed: int | None) -> int:
    """Verify all contributed archives; return the least favourable exit code."""
    from springbench.harness.cli.commands.archive import verify_one_archive

    archives = sorted(folder.glob("*.zip"))
    print_message(f"{len(archives)} entries in {folder}")
    codes: list[int] = []
    for path in archives:
        print_message(f"{path.name}:")
        if (size := path.stat().st_size) > MAX_ENTRY_BYTES:
            limit = f"at most {MAX_ENTRY_BYTES:,} are part of a clone"
            print_message(f"takes {size:,} bytes, and {limit}; run its sweep with `record: false, pictures: false`")
            codes.append(1)
        else:
            codes.append(verify_one_archive(path, seed, with_user_code=True))
    return _choose_exit_code(codes)
