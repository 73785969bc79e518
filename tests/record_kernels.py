"""Record which kernels the first runs call, for the processes that compile them together.

    python -m tests.record_kernels

Each solver runs in a process of its own, on two small meshes: some methods treat the smallest differently. So does the
search of `run --error`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from springbench.harness.experiments.kernel_precompilation import ERROR_CONTROL, SIGNATURES_PATH

SOLVERS = ("dense", "sparse", "numba", "hybrid")
"""Those of the quick start, and the one that runs a scene for which no solver is named."""

SIZES = (8, 24)
SCENE = Path(__file__).resolve().parents[1] / "configs" / "scenes" / "hanging-cloth.yaml"

_RECORD_RUN = """
import json, sys
from springbench.harness.cli.main import main
from springbench.solvers.jit.kernel_signatures import measure_called_kernels
path, sys.argv = sys.argv[1], ["springbench", *sys.argv[2:]]
try:
    main()
except SystemExit as end:
    if end.code:
        raise
with open(path, "w") as file:
    json.dump([*measure_called_kernels().items()], file)
"""


def record_kernels(caller: str) -> dict[str, int]:
    """Run a solver on the hanging cloth, or search for its cheapest method if the caller is ERROR_CONTROL.

    Returns: size of the machine code [bytes] of each kernel that it called; kernel and arguments are JSON.
    """
    with TemporaryDirectory() as folder:
        path, sweep = Path(folder) / "kernels.json", Path(folder) / "sweep.yaml"
        options = {"frames": 10, "pictures": False}
        keys = {"scenes": [str(SCENE)], "sizes": SIZES, "solvers": [caller], "options": options}
        sweep.write_text(json.dumps(keys))
        run = [str(sweep), "--in-process"]
        if caller == ERROR_CONTROL:
            run = [str(SCENE), "--size", "17", "--error", "1e-4", "--t-end", "0.1"]
        arguments = ["run", *run, "--results", folder]
        subprocess.run([sys.executable, "-c", _RECORD_RUN, str(path), *arguments], check=True, capture_output=True)
        return {json.dumps(signature): size for signature, size in json.loads(path.read_text())}


def format_signatures(recorded: Mapping[str, Mapping[str, int]]) -> str:
    """Return the content of the file, from what each caller calls; the kernels with the most code are the first."""
    sizes = {kernel: size for kernels in recorded.values() for kernel, size in kernels.items()}
    order = {kernel: number for number, kernel in enumerate(sorted(sizes, key=lambda kernel: (-sizes[kernel], kernel)))}
    callers = {caller: sorted(map(order.__getitem__, kernels)) for caller, kernels in recorded.items()}
    lines = {
        "callers": [f"{json.dumps(caller)}: {numbers}" for caller, numbers in callers.items()],
        "kernels": list(order),
    }
    parts = {name: ",\n    ".join(some) for name, some in lines.items()}
    return f'{{\n  "callers": {{\n    {parts["callers"]}\n  }},\n  "kernels": [\n    {parts["kernels"]}\n  ]\n}}\n'


if __name__ == "__main__":
    recorded = {caller: record_kernels(caller) for caller in (*SOLVERS, ERROR_CONTROL)}
    SIGNATURES_PATH.write_text(format_signatures(recorded))
