"""Compiled greedy colouring."""

from __future__ import annotations

from springbench.solvers.jit.kernel_compilation import jit_kernel


@jit_kernel
def first_fit(pointers, groups, back, items, colour, taken):
    """Write to `colour`, for each item in order, the first colour that no earlier item of its groups has.

    Args:
        pointers, groups: groups[pointers[a]:pointers[a + 1]] are the groups of item a.
        back, items: items[back[g]:back[g + 1]] are the items of group g, ascending.
        colour: output, one number per item.
        taken: scratch, one number per item, all -1.
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
