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


@wp.func
def factorise_saddle_envelope(
    begin: int,
    end: int,
    first: wp.array[wp.int32],
    rows: wp.array[wp.int64],
    # Data in and out:
    matrix: wp.array[wp.mat33d],
) -> bool:
    """Factorise a quasi-definite matrix L S Lᵀ with S = diag(1, 1, -1) at every vertex, the diagonal of L inverted.

    The third unknown of every vertex is a multiplier (:mod:`omtwarp.solvers.cholesky.saddle`). Returns whether all
    pivots have their signs.
    """
    for i in range(begin, end):
        for j in range(first[i], i + 1):
            both = wp.max(first[i], first[j])
            u = place_of(i, both, first, rows)
            v = place_of(j, both, first, rows)
            s00 = ZERO
            s01 = ZERO
            s02 = ZERO
            s10 = ZERO
            s11 = ZERO
            s12 = ZERO
            s20 = ZERO
            s21 = ZERO
            s22 = ZERO
            for k in range(j - both):
                x = matrix[u + k]
                y = matrix[v + k]
                s00 += x[0, 0] * y[0, 0] + x[0, 1] * y[0, 1] - x[0, 2] * y[0, 2]
                s01 += x[0, 0] * y[1, 0] + x[0, 1] * y[1, 1] - x[0, 2] * y[1, 2]
                s02 += x[0, 0] * y[2, 0] + x[0, 1] * y[2, 1] - x[0, 2] * y[2, 2]
                s10 += x[1, 0] * y[0, 0] + x[1, 1] * y[0, 1] - x[1, 2] * y[0, 2]
                s11 += x[1, 0] * y[1, 0] + x[1, 1] * y[1, 1] - x[1, 2] * y[1, 2]
                s12 += x[1, 0] * y[2, 0] + x[1, 1] * y[2, 1] - x[1, 2] * y[2, 2]
                s20 += x[2, 0] * y[0, 0] + x[2, 1] * y[0, 1] - x[2, 2] * y[0, 2]
                s21 += x[2, 0] * y[1, 0] + x[2, 1] * y[1, 1] - x[2, 2] * y[1, 2]
                s22 += x[2, 0] * y[2, 0] + x[2, 1] * y[2, 1] - x[2, 2] * y[2, 2]
            left = matrix[place_of(i, j, first, rows)] - wp.mat33d(s00, s01, s02, s10, s11, s12, s20, s21, s22)
            if j < i:
                own = matrix[place_of(j, j, first, rows)]
                for m in range(3):
                    y0 = left[m, 0] * own[0, 0]
                    y1 = (left[m, 1] - y0 * own[1, 0]) * own[1, 1]
                    y2 = (left[m, 2] - y0 * own[2, 0] - y1 * own[2, 1]) * own[2, 2]
                    left[m, 0] = y0
                    left[m, 1] = y1
                    left[m, 2] = -y2
                matrix[place_of(i, j, first, rows)] = left
            else:
                if not left[0, 0] > ZERO:
                    return False
                l00 = ONE / wp.sqrt(left[0, 0])
                l10 = left[1, 0] * l00
                l20 = left[2, 0] * l00
                pivot = left[1, 1] - l10 * l10
                if not pivot > ZERO:
                    return False
                l11 = ONE / wp.sqrt(pivot)
                l21 = (left[2, 1] - l20 * l10) * l11
                pivot = l20 * l20 + l21 * l21 - left[2, 2]
                if not pivot > ZERO:
                    return False
                l22 = ONE / wp.sqrt(pivot)
                matrix[place_of(i, i, first, rows)] = wp.mat33d(l00, ZERO, ZERO, l10, l11, ZERO, l20, l21, l22)
    return True


@wp.func
def solve_saddle_envelope(
    begin: int,
    end: int,
    first: wp.array[wp.int32],
    rows: wp.array[wp.int64],
    factor: wp.array[wp.mat33d],
    # Data in and out:
    x: wp.array[wp.vec3d],
):
    """Replace the right-hand side by the solution: two coordinates and the multiplier of every vertex."""
    for i in range(begin, end):
        s = x[i]
        for j in range(first[i], i):
            s = s - factor[place_of(i, j, first, rows)] * x[j]
        own = factor[place_of(i, i, first, rows)]
        s0 = s[0] * own[0, 0]
        s1 = (s[1] - own[1, 0] * s0) * own[1, 1]
        s2 = (s[2] - own[2, 0] * s0 - own[2, 1] * s1) * own[2, 2]
        x[i] = wp.vec3d(s0, s1, s2)
    for i in range(begin, end):
        s = x[i]
        x[i] = wp.vec3d(s[0], s[1], -s[2])
    for back in range(end - begin):
        i = end - 1 - back
        s = x[i]
        own = factor[place_of(i, i, first, rows)]
        s2 = s[2] * own[2, 2]
        s1 = (s[1] - own[2, 1] * s2) * own[1, 1]
        s0 = (s[0] - own[1, 0] * s1 - own[2, 0] * s2) * own[0, 0]
        s = wp.vec3d(s0, s1, s2)
        x[i] = s
        for j in range(first[i], i):
            x[j] = x[j] - wp.transpose(factor[place_of(i, j, first, rows)]) * s


__all__ = [
    "add_block",
    "diagonal_of",
    "factorise_envelope",
    "factorise_saddle_envelope",
    "place_of",
    "solve_envelope",
    "solve_saddle_envelope",
]
