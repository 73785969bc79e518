"""Speed report: solvers, a C++ baseline and roofline microbenchmarks, timed interleaved in one process."""
