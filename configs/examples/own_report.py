"""A figure of one's own: iterations a step, as a report, `reports: ["./own_report.py:iterations"]`."""

from pathlib import Path

import matplotlib.pyplot as plt
import pyarrow as pa
import springbench


def iterations(rows: pa.Table, folder: Path) -> list[Path]:
    """Draw how many iterations each solver needs, step by step."""
    figure, axes = plt.subplots()
    steps = [row for row in rows.to_pylist() if row["phase"] == "step" and row["round"] == 0]
    for solver in dict.fromkeys(row["solver"] for row in steps):
        mine = [row for row in steps if row["solver"] == solver]
        axes.plot([row["frame"] for row in mine], [row["num_iterations"] for row in mine], label=solver)
    axes.set(xlabel="step", ylabel="iterations")
    axes.legend()
    figure.savefig(path := folder / "iterations.png")
    return [path]


if __name__ == "__main__":
    sweep: springbench.SweepKeys = {
        "scenes": ["../scenes/hanging-cloth.yaml"],
        "sizes": [8],
        "solvers": ["sparse", "lbfgs"],
        "options": {"frames": 3, "max_iterations": 300, "rtol": 1e-3, "record": False, "pictures": False, "rounds": 1},
        "reports": [springbench.UserCodeName("./own_report.py:iterations")],
    }
    here = Path(globals().get("__file__", "configs/examples/own_report.py")).parent  # a notebook is no file
    rows = springbench.run_config(sweep, name="own-report", folder=here)
    print(f"{len(rows)} rows, and results/own-report/iterations.png")
