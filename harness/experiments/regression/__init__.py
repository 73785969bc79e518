"""Performance regression tests: interleaved paired benchmarks with a sequential test on the ratio of times."""
