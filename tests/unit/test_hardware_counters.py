"""The counter of instructions, on events that every Linux machine counts."""

import mmap

from springbench.harness.experiments.regression import hardware_counters
from springbench.harness.experiments.regression.hardware_counters import PAGE_FAULTS

PAGES = 1000


def test_an_event_of_the_kernels_own_is_counted_as_often_as_it_happens():
    if hardware_counters.explain_unavailable(PAGE_FAULTS):
        assert "cannot be counted" in hardware_counters.explain_unavailable(
            PAGE_FAULTS
        )  # a kernel without perf says so
        return

    # Every page of fresh memory faults once when it is touched; pages have 4 to 64 KiB, or 2 MiB where the kernel
    # hands out huge ones.
    def touch() -> None:
        with mmap.mmap(-1, 64 * 1024 * PAGES, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as fresh:
            fresh[:: mmap.PAGESIZE] = bytes(len(fresh) // mmap.PAGESIZE)

    found = hardware_counters.count_events(touch, PAGE_FAULTS)
    assert found is not None
    assert 20 <= found <= 17 * PAGES
    nothing = hardware_counters.count_events(lambda: None, PAGE_FAULTS)
    assert nothing is not None
    assert nothing < 20


def test_an_unknown_event_is_refused_with_the_systems_reason():
    unknown = (99, 99)
    assert hardware_counters.count_events(lambda: None, unknown) is None
    assert "cannot be counted" in hardware_counters.explain_unavailable(unknown)


def test_work_is_done_only_where_it_can_be_counted():
    done = []
    found = hardware_counters.count_events(lambda: done.append(1))
    assert (found is None) == (not done)
