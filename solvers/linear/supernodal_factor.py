"""The multifrontal Cholesky factorisation (Duff and Reid 1983) into the panels that a solve multiplies by.

A front is the dense matrix of a supernode's columns and rows. It is kept as strips of four columns, each with its
rows one after the other, so that taking out a chunk of columns is, strip by strip, the same
product as a pass forwards of the solve. For a chunk with Cholesky factor [L11; L21] the panel is

    S = L11^-T L11^-1       the inverse of the chunk's Schur complement
    W = -L21 L11^-1         what its unknowns add to the rows below

For springs S and W are sums of terms of one sign (Q is an M-matrix), so inverting loses no digits.
"""

from __future__ import annotations

import numpy as np

from solvers.compiling import kept, part
from solvers.linear.supernodes import WIDTH
from solvers.vectors.supernodal import add_forward

_NO_DIGITS = 4.0 * np.finfo(np.float64).eps
"""A pivot this small beside its entry of the matrix is round-off."""


@kept()
def factorise(
    pointers,
    neighbours,
    values,
    slot,
    vertex,
    parent,
    first,
    row_start,
    rows,
    sequence,
    chunk_of,
    chunks,
    squares,
    panels,
):
    """Fill `squares` (S) and `panels` (W) from a matrix (CSR) in the supernodes' `sequence`, a postorder of their tree.

    chunk_of (s + 1,): the first chunk of each supernode; chunks (c, 7): see `solvers.linear.supernodal.Layout`.
    Returns the vertex whose pivot is not positive, or -1.
    """
    nodes = len(parent)
    child = np.full(nodes, -1, np.int64)
    sibling = np.full(nodes, -1, np.int64)
    largest = 0
    room, depth = 0, 0
    for s in sequence:  # what the stack of update matrices needs at most
        below = _padded(row_start[s + 1] - row_start[s])
        largest = max(largest, first[s + 1] - first[s] + below)
        c = child[s]
        while c >= 0:
            depth -= _padded(row_start[c + 1] - row_start[c]) ** 2
            c = sibling[c]
        depth += below**2
        room = max(room, depth)
        if parent[s] >= 0:
            sibling[s] = child[parent[s]]
            child[parent[s]] = s
    stack = np.empty(room)
    begun = np.zeros(nodes, np.int64)  # where a supernode's update matrix lies
    front = np.empty(largest * largest)
    panel = np.empty((largest, WIDTH))
    tiles = np.empty(largest * WIDTH)
    block = np.empty((WIDTH, 4))
    inverse = np.empty((WIDTH, WIDTH))
    place = np.empty(len(vertex), np.int64)  # of a slot in the front
    index = np.arange(largest).astype(np.int32)
    top = 0
    for s in sequence:
        own = first[s + 1] - first[s]
        below = row_start[s + 1] - row_start[s]
        size = own + _padded(below)
        front[: size * size] = 0.0
        for i in range(first[s], first[s + 1]):
            place[i] = i - first[s]
        for k in range(below):
            place[rows[row_start[s] + k]] = own + k
        for i in range(first[s], first[s + 1]):
            col = i - first[s]
            v = vertex[i]
            if v < 0:
                front[_at(size, col, col)] = 1.0
                continue
            for e in range(pointers[v], pointers[v + 1]):
                j = slot[neighbours[e]]
                if j >= i:
                    front[_at(size, place[j], col)] += values[e]
        c = child[s]
        while c >= 0:
            top = begun[c]  # the last in this list was the first on the stack
            _extend_add(front, size, stack, top, rows, row_start[c], row_start[c + 1], place)
            c = sibling[c]
        for k in range(chunk_of[s], chunk_of[s + 1]):
            start = (k - chunk_of[s]) * WIDTH
            bad = _eliminate(
                front,
                size,
                start,
                chunks[k],
                vertex,
                pointers,
                neighbours,
                values,
                first[s],
                own,
                below,
                panel,
                tiles,
                block,
                inverse,
                index,
                squares,
                panels,
            )
            if bad >= 0:
                return bad
        rest = size - own
        begun[s] = top
        for strip in range(rest // 4):
            source = 4 * ((strip + own // 4) * size + own)
            target = top + 4 * strip * rest
            for k in range(16 * strip, 4 * rest):
                stack[target + k] = front[source + k]
        top += rest * rest
    return -1


@part
def _padded(count):
    """The count, rounded up to whole strips."""
    return (count + 3) // 4 * 4


@part
def _at(size, row, col):
    """Where a front of a size has an entry."""
    return 4 * ((col >> 2) * size + row) + (col & 3)


@part
def _in_tile(row, col, width):
    """Where a panel of a width has an entry: by tiles of four rows, each column by column."""
    return (row >> 2) * 4 * width + 4 * col + (row & 3)


@part
def _extend_add(front, size, stack, begin, rows, start, end, place):
    """Add a child's update matrix to its parent's front."""
    count = end - start
    height = _padded(count)
    for b in range(count):
        source = begin + 4 * (b >> 2) * height + (b & 3)
        col = place[rows[start + b]]
        target = 4 * (col >> 2) * size + (col & 3)
        for a in range(b, count):
            front[target + 4 * place[rows[start + a]]] += stack[source + 4 * a]


@part
def _eliminate(
    front,
    size,
    start,
    chunk,
    vertex,
    pointers,
    neighbours,
    values,
    first,
    own,
    below,
    panel,
    tiles,
    block,
    inverse,
    index,
    squares,
    panels,
):
    """Take the chunk of columns that begins at `start` out of the front, and write its panel."""
    square, at, real, quads = chunk[0], chunk[1], chunk[3], chunk[5]
    width = 4 * quads
    for q in range(quads):
        strip = 4 * ((start // 4 + q) * size + start)
        for r in range(size - start):
            for c in range(4):
                panel[r, 4 * q + c] = front[strip + 4 * r + c]
    for j in range(width):  # L11 in place
        pivot = panel[j, j]
        v = vertex[first + start + j]
        scale = 0.0
        if v >= 0:
            for e in range(pointers[v], pointers[v + 1]):
                if neighbours[e] == v:
                    scale += values[e]
        if not pivot > _NO_DIGITS * scale:
            return v
        root = np.sqrt(pivot)
        panel[j, j] = root
        for i in range(j + 1, width):
            panel[i, j] /= root
        for k in range(j + 1, width):
            for i in range(k, width):
                panel[i, k] -= panel[i, j] * panel[k, j]
    for j in range(width):  # its inverse, column by column
        for i in range(width):
            inverse[i, j] = 0.0
        inverse[j, j] = 1.0 / panel[j, j]
        for i in range(j + 1, width):
            total = 0.0
            for k in range(j, i):
                total -= panel[i, k] * inverse[k, j]
            inverse[i, j] = total / panel[i, i]
    for i in range(real):  # S
        for j in range(real):
            total = 0.0
            for k in range(max(i, j), real):
                total += inverse[k, i] * inverse[k, j]
            squares[square + _in_tile(i, j, width)] = total
    row = np.empty(WIDTH)
    for r in range(width, size - start):
        for j in range(width):  # L21 = A21 L11^-T
            row[j] = 0.0
        for k in range(width):
            factor = panel[r, k]
            for j in range(width):
                row[j] += factor * inverse[j, k]
        for j in range(width):
            tiles[_in_tile(r, j, width)] = row[j]
    done = 0
    for r in range(width, size - start):
        local = start + r
        if local < own:
            if vertex[first + local] < 0:
                continue
        elif local - own >= below:
            continue
        for j in range(width):
            row[j] = 0.0
        for k in range(width):
            factor = tiles[_in_tile(r, k, width)]
            for j in range(width):
                row[j] -= factor * inverse[k, j]
        for j in range(width):
            panels[at + _in_tile(done, j, width)] = row[j]
        done += 1
    flat = block.ravel()
    for strip in range((start + width) // 4, size // 4):
        r = 4 * strip - start
        for c in range(4):
            for j in range(width):
                flat[4 * j + c] = -tiles[_in_tile(r + c, j, width)]
        begin = strip * size + 4 * strip
        count = size - 4 * strip
        if quads == 4:
            add_forward(tiles, r * width, index, 0, count, flat, 0, front, begin, 4, 4)
        elif quads == 3:
            add_forward(tiles, r * width, index, 0, count, flat, 0, front, begin, 4, 3)
        elif quads == 2:
            add_forward(tiles, r * width, index, 0, count, flat, 0, front, begin, 4, 2)
        else:
            add_forward(tiles, r * width, index, 0, count, flat, 0, front, begin, 4, 1)
    return -1


@kept()
def keep_sums(panels, rounding, chunks):
    """Add what rounding takes from a column of W as a whole to its smallest entry, where it is rounded the least.

    A column holds the weights with which a vertex follows those below. Noise in their sum would part vertices that
    ought to move together, against stiff springs: the largest eigenvalue of what a solve makes of Q, 1 for no rounding,
    was 1.028 on a sheet of 128 x 128 vertices and grew with their number; with the sums kept it is 1.0002 at any.
    A row that fills up a tile will do as well: it names the last one.
    rounding: each entry less what it is rounded to.
    """
    for k in range(len(chunks)):
        offset, below, width = chunks[k, 1], chunks[k, 4], 4 * chunks[k, 5]
        for j in range(width if below > 0 else 0):
            lost = 0.0
            least = offset + 4 * j
            for r in range(below):
                at = offset + _in_tile(r, j, width)
                lost += rounding[at]
                if abs(panels[at]) < abs(panels[least]):
                    least = at
            panels[least] += lost
