"""Kernels of the multigrid cycle: products with sparse rows, Gauss-Seidel by colours, Galerkin products.

Vectors and matrices are flat: component u of node i of a vector with b unknowns per node is ``x[b i + u]``, entry
(u, v) of the k-th block of a matrix with b by c blocks is ``values[b c k + c u + v]``. Every thread owns one number (or
one node) of the result and adds in the order of the rows, so that the bits do not depend on how threads are scheduled.
"""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)

# Blocks of coarse levels lose rank where an aggregate has too few vertices to rotate: this share of the trace is added.
RANK_FLOOR = wp.constant(wp.float64(1e-12))
# A pivot this small against its diagonal is rounding error from finer levels: its unknown is held at zero.
SMALLEST_PIVOT = wp.constant(wp.float64(1e-9))


@wp.kernel
def fill_rows(
    source: wp.array[wp.int32],
    block: int,
    diagonal: wp.array[wp.float64],
    off_diagonal: wp.array[wp.float64],
    # Data out:
    values: wp.array[wp.float64],
):
    """Compute the entries of compressed rows from blocks of vertices and edges, one thread per number.

    ``source`` of an entry is 3 i for the diagonal of vertex i, 3 e + 1 for edge e as it is, 3 e + 2 for its transpose.
    """
    at = wp.tid()
    width = block * block
    k = at // width
    q = at - width * k
    code = source[k]
    index = code // 3
    kind = code - 3 * index
    if kind == 0:
        values[at] = diagonal[width * index + q]
    elif kind == 1:
        values[at] = off_diagonal[width * index + q]
    else:
        u = q // block
        v = q - block * u
        values[at] = off_diagonal[width * index + block * v + u]


@wp.kernel
def laplacian_diagonal(
    offsets: wp.array[wp.int32],
    source: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    # Data out:
    diagonal: wp.array[wp.float64],
):
    """Compute the diagonal of a Laplacian: the weights of a vertex's edges, summed in the order of its row."""
    i = wp.tid()
    total = wp.float64(0.0)
    for k in range(offsets[i], offsets[i + 1]):
        if source[k] % 3 != 0:
            total += weights[source[k] // 3]
    diagonal[i] = total


@wp.kernel
def negate_values(
    # Data in and out:
    values: wp.array[wp.float64],
):
    i = wp.tid()
    values[i] = -values[i]


@wp.kernel
def invert_diagonal_b1(
    diagonal: wp.array[wp.int32],
    values: wp.array[wp.float64],
    # Data out:
    inverse: wp.array[wp.float64],
):
    i = wp.tid()
    inverse[i] = ONE / values[diagonal[i]]


@wp.kernel
def invert_diagonal_b2(
    diagonal: wp.array[wp.int32],
    values: wp.array[wp.float64],
    # Data out:
    inverse: wp.array[wp.float64],
):
    i = wp.tid()
    at = 4 * diagonal[i]
    block = wp.mat22d(values[at], values[at + 1], values[at + 2], values[at + 3])
    floor = RANK_FLOOR * (block[0, 0] + block[1, 1])
    block[0, 0] += floor
    block[1, 1] += floor
    solved = wp.inverse(block)
    for u in range(2):
        for v in range(2):
            inverse[4 * i + 2 * u + v] = solved[u, v]


@wp.kernel
def invert_diagonal_b3(
    diagonal: wp.array[wp.int32],
    values: wp.array[wp.float64],
    # Data out:
    inverse: wp.array[wp.float64],
):
    """Invert by square-root-free elimination, whose pivots stay positive where Cramer's rule loses all digits."""
    i, _compiled_once = wp.tid()
    at = 9 * diagonal[i]
    floor = RANK_FLOOR * (values[at] + values[at + 4] + values[at + 8])
    d0 = values[at] + floor
    l10 = values[at + 1] / d0
    l20 = values[at + 2] / d0
    d1 = wp.max(values[at + 4] + floor - l10 * l10 * d0, floor)
    l21 = (values[at + 5] - l20 * l10 * d0) / d1
    d2 = wp.max(values[at + 8] + floor - l20 * l20 * d0 - l21 * l21 * d1, floor)
    # The rows of the inverse of L, then L^-T D^-1 L^-1.
    m20 = l10 * l21 - l20
    inverse[9 * i] = ONE / d0 + l10 * l10 / d1 + m20 * m20 / d2
    inverse[9 * i + 1] = -l10 / d1 - m20 * l21 / d2
    inverse[9 * i + 2] = m20 / d2
    inverse[9 * i + 3] = -l10 / d1 - m20 * l21 / d2
    inverse[9 * i + 4] = ONE / d1 + l21 * l21 / d2
    inverse[9 * i + 5] = -l21 / d2
    inverse[9 * i + 6] = m20 / d2
    inverse[9 * i + 7] = -l21 / d2
    inverse[9 * i + 8] = ONE / d2


@wp.kernel
def gauss_seidel_b1(
    nodes: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
    right: wp.array[wp.float64],
    # Data in and out:
    x: wp.array[wp.float64],
):
    """Solve the equations of the nodes of one colour for their own unknown."""
    i = nodes[wp.tid()]
    residual = right[i]
    for k in range(offsets[i], offsets[i + 1]):
        residual -= values[k] * x[columns[k]]
    x[i] = x[i] + inverse[i] * residual


@wp.kernel
def gauss_seidel_b2(
    nodes: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
    right: wp.array[wp.float64],
    # Data in and out:
    x: wp.array[wp.float64],
):
    """Solve the 2 by 2 equations of the nodes of one colour for their own unknowns."""
    i = nodes[wp.tid()]
    r0 = right[2 * i]
    r1 = right[2 * i + 1]
    for k in range(offsets[i], offsets[i + 1]):
        x0 = x[2 * columns[k]]
        x1 = x[2 * columns[k] + 1]
        r0 -= values[4 * k] * x0 + values[4 * k + 1] * x1
        r1 -= values[4 * k + 2] * x0 + values[4 * k + 3] * x1
    x[2 * i] = x[2 * i] + inverse[4 * i] * r0 + inverse[4 * i + 1] * r1
    x[2 * i + 1] = x[2 * i + 1] + inverse[4 * i + 2] * r0 + inverse[4 * i + 3] * r1


@wp.kernel
def gauss_seidel_b3(
    nodes: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
    right: wp.array[wp.float64],
    # Data in and out:
    x: wp.array[wp.float64],
):
    """Solve the 3 by 3 equations of the nodes of one colour for their own unknowns."""
    i = nodes[wp.tid()]
    r0 = right[3 * i]
    r1 = right[3 * i + 1]
    r2 = right[3 * i + 2]
    for k in range(offsets[i], offsets[i + 1]):
        x0 = x[3 * columns[k]]
        x1 = x[3 * columns[k] + 1]
        x2 = x[3 * columns[k] + 2]
        r0 -= values[9 * k] * x0 + values[9 * k + 1] * x1 + values[9 * k + 2] * x2
        r1 -= values[9 * k + 3] * x0 + values[9 * k + 4] * x1 + values[9 * k + 5] * x2
        r2 -= values[9 * k + 6] * x0 + values[9 * k + 7] * x1 + values[9 * k + 8] * x2
    x[3 * i] = x[3 * i] + inverse[9 * i] * r0 + inverse[9 * i + 1] * r1 + inverse[9 * i + 2] * r2
    x[3 * i + 1] = x[3 * i + 1] + inverse[9 * i + 3] * r0 + inverse[9 * i + 4] * r1 + inverse[9 * i + 5] * r2
    x[3 * i + 2] = x[3 * i + 2] + inverse[9 * i + 6] * r0 + inverse[9 * i + 7] * r1 + inverse[9 * i + 8] * r2


@wp.func
def row_product(
    at: int,
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    b: int,
    c: int,
    x: wp.array[wp.float64],
) -> wp.float64:
    """Return component ``at`` of A x, where A has blocks of b by c."""
    i = at // b
    u = at - b * i
    total = wp.float64(0.0)
    for k in range(offsets[i], offsets[i + 1]):
        for v in range(c):
            total += values[(b * k + u) * c + v] * x[c * columns[k] + v]
    return total


@wp.kernel
def multiply_rows(
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    b: int,
    c: int,
    x: wp.array[wp.float64],
    # Data out:
    product: wp.array[wp.float64],
):
    """Compute A x, one thread per unknown."""
    at = wp.tid()
    product[at] = row_product(at, offsets, columns, values, b, c, x)


@wp.kernel
def multiply_and_add(
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    b: int,
    c: int,
    factor: wp.float64,
    x: wp.array[wp.float64],
    added: wp.array[wp.float64],
    # Data out:
    result: wp.array[wp.float64],
):
    """Compute added + factor A x, one thread per unknown; ``result`` may be ``added``."""
    at = wp.tid()
    result[at] = added[at] + factor * row_product(at, offsets, columns, values, b, c, x)


@wp.kernel
def restrict_to_coarse(
    offsets: wp.array[wp.int32],
    nodes: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    prolongation: wp.array[wp.float64],
    b: int,
    c: int,
    fine: wp.array[wp.float64],
    # Data out:
    coarse: wp.array[wp.float64],
):
    """Compute Pᵀ fine, by the columns of P, one thread per coarse unknown."""
    at = wp.tid()
    i = at // c
    v = at - c * i
    total = wp.float64(0.0)
    for m in range(offsets[i], offsets[i + 1]):
        for u in range(b):
            total += prolongation[(b * entries[m] + u) * c + v] * fine[b * nodes[m] + u]
    coarse[at] = total


@wp.func
def block_entry(at: int, b: int, c: int):
    """Return which block of b by c the number ``at`` belongs to, its row there, and its column."""
    k = at // (b * c)
    q = at - b * c * k
    u = q // c
    return k, u, q - c * u


@wp.kernel
def smooth_prolongation(
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
    aggregates: wp.array[wp.int32],
    tentative: wp.array[wp.float64],
    damping: wp.float64,
    b: int,
    c: int,
    rows: wp.array[wp.int32],
    targets: wp.array[wp.int32],
    # Data out:
    prolongation: wp.array[wp.float64],
):
    """Compute (I - damping D^-1 A) T, one thread per number."""
    at, _compiled_once = wp.tid()
    e, u, v = block_entry(at, b, c)
    i = rows[e]
    target = targets[e]
    total = wp.float64(0.0)
    for k in range(offsets[i], offsets[i + 1]):
        j = columns[k]
        if aggregates[j] == target:
            for w in range(b):
                for x in range(b):
                    total += inverse[(b * i + u) * b + w] * values[(b * k + w) * b + x] * tentative[(b * j + x) * c + v]
    own = wp.float64(0.0)
    if aggregates[i] == target:
        own = tentative[(b * i + u) * c + v]
    prolongation[at] = own - damping * total


@wp.func
def position(column: int, begin: int, end: int, columns: wp.array[wp.int32]) -> int:
    """Return the place of a column in a short row, -1 where the row lacks it."""
    found = int(-1)
    for m in range(begin, end):
        if columns[m] == column:
            found = m
    return found


@wp.kernel
def multiply_by_prolongation(
    rows: wp.array[wp.int32],
    targets: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    p_offsets: wp.array[wp.int32],
    p_columns: wp.array[wp.int32],
    prolongation: wp.array[wp.float64],
    b: int,
    c: int,
    # Data out:
    product: wp.array[wp.float64],
):
    """Compute A P, one thread per number."""
    at, _compiled_once = wp.tid()
    e, u, v = block_entry(at, b, c)
    i = rows[e]
    total = wp.float64(0.0)
    for k in range(offsets[i], offsets[i + 1]):
        j = columns[k]
        m = position(targets[e], p_offsets[j], p_offsets[j + 1], p_columns)
        if m >= 0:
            for w in range(b):
                total += values[(b * k + u) * b + w] * prolongation[(b * m + w) * c + v]
    product[at] = total


@wp.kernel
def coarse_matrix(
    rows: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    nodes: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    prolongation: wp.array[wp.float64],
    product_offsets: wp.array[wp.int32],
    product_columns: wp.array[wp.int32],
    product: wp.array[wp.float64],
    b: int,
    c: int,
    # Data out:
    coarse: wp.array[wp.float64],
):
    """Compute Pᵀ (A P), one thread per number."""
    at, _compiled_once = wp.tid()
    e, u, v = block_entry(at, c, c)
    total = wp.float64(0.0)
    for m in range(offsets[rows[e]], offsets[rows[e] + 1]):
        i = nodes[m]
        k = position(columns[e], product_offsets[i], product_offsets[i + 1], product_columns)
        if k >= 0:
            for w in range(b):
                total += prolongation[(b * entries[m] + w) * c + u] * product[(b * k + w) * c + v]
    coarse[at] = total


@wp.kernel
def scatter_dense(
    rows: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.float64],
    c: int,
    # Data out:
    dense: wp.array2d[wp.float64],
    scale: wp.array[wp.float64],
):
    """Scatter compressed rows of c by c blocks to a dense matrix, and its diagonal to an array.

    Every entry is written once.
    """
    at = wp.tid()
    e, u, v = block_entry(at, c, c)
    i = c * rows[e] + u
    j = c * columns[e] + v
    dense[i, j] = values[at]
    if i == j:
        scale[i] = values[at]


@wp.kernel
def eliminate_pivot(
    pivot: int,
    scale: wp.array[wp.float64],
    before: wp.array2d[wp.float64],
    # Data out:
    after: wp.array2d[wp.float64],
):
    """Take one step of Gauss and Jordan's inversion; after all steps ``after`` is the inverse."""
    i, j = wp.tid()
    divisor = before[pivot, pivot]
    share = wp.float64(0.0)
    if divisor > SMALLEST_PIVOT * scale[pivot]:
        share = ONE / divisor
    if i == pivot and j == pivot:
        after[i, j] = share
    elif i == pivot:
        after[i, j] = before[i, j] * share
    elif j == pivot:
        after[i, j] = -before[i, j] * share
    else:
        after[i, j] = before[i, j] - before[i, pivot] * before[pivot, j] * share


@wp.kernel
def multiply_dense(
    matrix: wp.array2d[wp.float64],
    right: wp.array[wp.float64],
    # Data out:
    x: wp.array[wp.float64],
):
    """Compute the product with a symmetric matrix, given by its lower triangle so that rounding keeps it symmetric."""
    i = wp.tid()
    total = wp.float64(0.0)
    for j in range(right.shape[0]):
        total += matrix[wp.max(i, j), wp.min(i, j)] * right[j]
    x[i] = total


@wp.kernel
def identity_blocks(
    b: int,
    # Data out:
    blocks: wp.array[wp.float64],
):
    at = wp.tid()
    _, u, v = block_entry(at, b, b)
    if u == v:
        blocks[at] = ONE
    else:
        blocks[at] = ZERO
