"""All vector code is compared with plain Numba by `python -m tests.bench.vectors`."""

from pathlib import Path

from springbench.solvers.simd import llvm_vectors

from tests.bench.vectors import CASES, build_spring_cases


def test_every_file_of_vectors_is_measured_except_shared_ones():
    solvers = Path(llvm_vectors.__file__).parents[1]
    files = {path.stem for path in solvers.glob("simd/*.py")} | {
        path.stem for path in solvers.glob("methods/**/*_packets.py")
    }
    assert files - {"__init__", "llvm_vectors", "spring_packets", "edge_packets"} == CASES.keys()


def test_the_norm_of_q_reads_within_its_displacement():
    (norm,) = (case for case in build_spring_cases() if case.name == "norm of Q")
    packets, displacement = norm.arguments[0], norm.arguments[3]
    assert max(packets.row_offset.max(), packets.neighbour_offset.max()) + 3 <= len(displacement)
