"""Reports of expected errors: a message and an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager

from springbench.harness.atomic_files import USER_ERRNOS, describe_os_error
from springbench.harness.console import enable_logging, print_message
from springbench.harness.errors import InputError, SpringbenchError
from springbench.harness.execution.optional_parts import find_part


@contextmanager
def report_errors() -> Generator[None]:
    """Report expected errors of the block: the project's own, and those of the system.

    Log messages are printed as well.

    Raises:
        SystemExit: for an expected error.
    """
    enable_logging()
    try:
        yield
    except SpringbenchError as error:
        for mistake in getattr(error, "mistakes", (error,)):
            print_message(f"springbench: {mistake}")
        raise SystemExit(error.exit_code) from error
    except ModuleNotFoundError as error:
        part = find_part(error)
        if part is None:
            raise
        print_message(f"springbench: {part.describe_absence()}")
        raise SystemExit(InputError.exit_code) from error
    except BrokenPipeError:  # the reader of the output closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:
        print_message(f"springbench: {describe_os_error(error)}")
        raise SystemExit(2 if error.errno in USER_ERRNOS else 1) from error
    except MemoryError as error:
        print_message("springbench: there is not enough memory for this; take a smaller mesh")
        raise SystemExit(1) from error
