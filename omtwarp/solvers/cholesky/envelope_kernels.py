"""Cholesky factors of small matrices within their envelope, as Warp functions: one thread factorises one matrix.

A matrix has two unknowns for every vertex. Row by row, all entries from the first that is not zero to the diagonal are
kept, which are the ones that elimination can fill (George and Liu, "Computer Solution of Large Sparse Positive Definite
Systems", 1981, chapter 4). The 2x2 blocks of vertex i with the vertices first[i] to i follow one another from rows[i]
on. Sums are assigned, as Warp adds atomically to an array's element by `+=`.
"""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def place_of(i: int, j: int, first: wp.array[wp.int32], rows: wp.array[wp.int64]) -> int:
    """Return where the block with rows of vertex i and columns of vertex j is, first[i] <= j <= i."""
    return int(rows[i]) + j - first[i]


@wp.func
def add_block(
    i: int,
    j: int,
    block: wp.mat22d,
    first: wp.array[wp.int32],
    rows: wp.array[wp.int64],
    # Data in and out:
    matrix: wp.array[wp.mat22d],
):
    """Add a block with rows of vertex i and columns of vertex j <= i; on the diagonal it is symmetric."""
    at = place_of(i, j, first, rows)
    matrix[at] = matrix[at] + block


@wp.func
def diagonal_of(i: int, first: wp.array[wp.int32], rows: wp.array[wp.int64], matrix: wp.array[wp.mat22d]) -> wp.vec2d:
    """Return the two entries of a vertex on the diagonal, before the matrix is factorised."""
    block = matrix[place_of(i, i, first, rows)]
    return wp.vec2d(block[0, 0], block[1, 1])


@wp.func
def factorise_envelope(
    begin: int,
    end: int,
    first: wp.array[wp.int32],
    rows: wp.array[wp.int64],
    # Data in and out:
    matrix: wp.array[wp.mat22d],
) -> bool:
    """Replace the matrix of the vertices begin to end - 1 by its Cholesky factor, with the diagonal inverted.

    Returns whether all pivots are positive.
    """
    for i in range(begin, end):
        for j in range(first[i], i + 1):
            both = wp.max(first[i], first[j])
            u = place_of(i, both, first, rows)
            v = place_of(j, both, first, rows)
            s00 = ZERO
            s01 = ZERO
            s10 = ZERO
            s11 = ZERO
            for k in range(j - both):
                x = matrix[u + k]
                y = matrix[v + k]
                s00 += x[0, 0] * y[0, 0] + x[0, 1] * y[0, 1]
                s01 += x[0, 0] * y[1, 0] + x[0, 1] * y[1, 1]
                s10 += x[1, 0] * y[0, 0] + x[1, 1] * y[0, 1]
                s11 += x[1, 0] * y[1, 0] + x[1, 1] * y[1, 1]
            at = place_of(i, j, first, rows)
            left = matrix[at] - wp.mat22d(s00, s01, s10, s11)
            if j < i:
                own = matrix[place_of(j, j, first, rows)]
                x0 = left[0, 0] * own[0, 0]
                x1 = left[1, 0] * own[0, 0]
                y0 = (left[0, 1] - x0 * own[1, 0]) * own[1, 1]
                y1 = (left[1, 1] - x1 * own[1, 0]) * own[1, 1]
                matrix[at] = wp.mat22d(x0, y0, x1, y1)
            else:
                if not left[0, 0] > ZERO:
                    return False
                inverse = ONE / wp.sqrt(left[0, 0])
                between = left[1, 0] * inverse
                pivot = left[1, 1] - between * between
                if not pivot > ZERO:
                    return False
                matrix[at] = wp.mat22d(inverse, ZERO, between, ONE / wp.sqrt(pivot))
    return True


@wp.func
def solve_envelope(
    begin: int,
    end: int,
    first: wp.array[wp.int32],
    rows: wp.array[wp.int64],
    factor: wp.array[wp.mat22d],
    # Data in and out:
    x: wp.array[wp.float64],
):
    """Replace the right-hand side, two numbers a vertex, by the solution."""
    for i in range(begin, end):
        s0 = x[2 * i]
        s1 = x[2 * i + 1]
        for j in range(first[i], i):
            block = factor[place_of(i, j, first, rows)]
            s0 -= block[0, 0] * x[2 * j] + block[0, 1] * x[2 * j + 1]
            s1 -= block[1, 0] * x[2 * j] + block[1, 1] * x[2 * j + 1]
        own = factor[place_of(i, i, first, rows)]
        s0 = s0 * own[0, 0]
        x[2 * i] = s0
        x[2 * i + 1] = (s1 - own[1, 0] * s0) * own[1, 1]
    for back in range(end - begin):
        i = end - 1 - back
        own = factor[place_of(i, i, first, rows)]
        s1 = x[2 * i + 1] * own[1, 1]
        s0 = (x[2 * i] - own[1, 0] * s1) * own[0, 0]
        x[2 * i] = s0
        x[2 * i + 1] = s1
        for j in range(first[i], i):
            block = factor[place_of(i, j, first, rows)]
            x[2 * j] = x[2 * j] - (block[0, 0] * s0 + block[1, 0] * s1)
            x[2 * j + 1] = x[2 * j + 1] - (block[0, 1] * s0 + block[1, 1] * s1)


__all__ = ["add_block", "diagonal_of", "factorise_envelope", "place_of", "solve_envelope"]
