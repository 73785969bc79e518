"""The speed report: solvers, a yardstick in C++ and the machine's own limits, taking turns in one process."""
