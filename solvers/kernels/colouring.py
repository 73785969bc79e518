"""Greedy colouring, compiled."""

from __future__ import annotations

from solvers.compiling import kernel


@kernel
def first_fit(pointers, groups, back, items, colour, taken):
    """Write to `colour`, for each item in turn, the first that no earlier item of its groups has.

    groups[pointers[a]:pointers[a + 1]]: those of item a; items[back[g]:back[g + 1]]: those of group g, ascending;
    taken: scratch, one number an item, all -1.
    """
    for a in range(len(colour)):
        for k in range(pointers[a], pointers[a + 1]):
            for other in items[back[groups[k]] : back[groups[k] + 1]]:
                if other >= a:
                    break
                taken[colour[other]] = a
        c = 0
        while taken[c] == a:
            c += 1
        colour[a] = c
