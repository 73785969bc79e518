"""Console script: prepares the process, then imports and runs the command line.

The handler of Ctrl-C is installed before anything else is imported.
"""

from __future__ import annotations

import os
import sys
from io import TextIOWrapper

from springbench.harness.execution import garbage_collection, interrupts


def main() -> None:
    """Run the command that the arguments name."""
    interrupts.install_handler()
    garbage_collection.postpone_collections()
    try:
        from springbench.harness.console import show_activity

        _prepare_environment()
        if len(sys.argv) > 1:
            show_activity("loading")
        from springbench.harness.cli.early_start import start_early

        if not start_early(sys.argv[1:]):
            from springbench.harness.cli.main import main as run_command

            run_command()
    except BaseException as end:
        # After Ctrl-C, clean-up code may raise anything, and Typer turns a KeyboardInterrupt into an exit code.
        if interrupts.is_interrupted() or isinstance(end, KeyboardInterrupt):
            interrupts.exit_process()
        raise
    finally:
        interrupts.ignore_interrupts()
        garbage_collection.skip_final_collections()


def _prepare_environment() -> None:
    """Set the environment of all commands, and override settings that none can use.

    Exit with code 2 for an invalid one.
    """
    from springbench.harness.execution import pandas_deferral

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what a terminal cannot write is written as an escape sequence
            stream.reconfigure(errors="backslashreplace")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # else it searches all packages for them
    os.environ["MPLBACKEND"] = "agg"  # all pictures go to files
    pandas_deferral.request_deferral()
    threads = os.environ.get("NUMBA_NUM_THREADS") or "1"
    if not threads.isdecimal() or int(threads) < 1:
        print(
            f"springbench: the environment's NUMBA_NUM_THREADS is {threads!r}; expected a number from 1",
            file=sys.stderr,
        )
        sys.exit(2)


if __name__ == "__main__":
    main()
