"""Warp kernels of the lifted wavelet transforms: one predict and one update per level, in place, and their adjoints.

The values of all levels share one array, coarse nodes first: node k of K(j) at ``k``, node m of M(j) at ``first + m``.
A thread adds to its own element alone, spelt out: ``+=`` on an array is an atomic addition in Warp.
"""

# mypy: ignore-errors
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def predict_nodes(
    first: wp.int32,
    stencil: wp.array2d[wp.int32],
    weights: wp.array[wp.float64],
    sign: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    """Add (sign) x (prediction from coarse nodes) to each new node."""
    m = wp.tid()
    total = wp.float64(0.0)
    for s in range(stencil.shape[1]):
        total += weights[s] * values[stencil[m, s]]
    values[first + m] = values[first + m] + sign * total


@wp.kernel
def predict_adjoint(
    first: wp.int32,
    offsets: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    width: wp.int32,
    weights: wp.array[wp.float64],
    sign: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    """Add (sign) x (the new nodes it predicts) to each coarse node; an entry is ``width`` m + place in the stencil."""
    k = wp.tid()
    total = wp.float64(0.0)
    for n in range(offsets[k], offsets[k + 1]):
        m = entries[n] // width
        total += weights[entries[n] - width * m] * values[first + m]
    values[k] = values[k] + sign * total


@wp.kernel
def update_nodes(
    first: wp.int32,
    offsets: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    fine_integrals: wp.array[wp.float64],
    coarse_integrals: wp.array[wp.float64],
    sign: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    """Add (sign) x (sum of s gamma over the edges at each coarse node), s = I(j + 1, m) / (2 I(j, k))."""
    k = wp.tid()
    total = wp.float64(0.0)
    for n in range(offsets[k], offsets[k + 1]):
        m = first + entries[n] // 2
        total += fine_integrals[m] * values[m]
    values[k] = values[k] + sign * HALF * total / coarse_integrals[k]


@wp.kernel
def update_adjoint(
    first: wp.int32,
    parents: wp.array2d[wp.int32],
    fine_integrals: wp.array[wp.float64],
    coarse_integrals: wp.array[wp.float64],
    sign: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    m = wp.tid()
    a, b = parents[m, 0], parents[m, 1]
    total = values[a] / coarse_integrals[a] + values[b] / coarse_integrals[b]
    values[first + m] = values[first + m] + sign * HALF * fine_integrals[first + m] * total


@wp.kernel
def clear_from(
    first: wp.int32,
    # Data out:
    values: wp.array[wp.float64],
):
    values[first + wp.tid()] = ZERO


@wp.kernel
def scale_values(
    factors: wp.array[wp.float64],
    # Data in and out:
    values: wp.array[wp.float64],
):
    i = wp.tid()
    values[i] = factors[i] * values[i]


@wp.kernel
def dense_product(
    matrix: wp.array2d[wp.float64],
    values: wp.array[wp.float64],
    # Data out:
    product: wp.array[wp.float64],
):
    """Multiply the first entries of ``values`` by a small dense matrix."""
    i = wp.tid()
    total = wp.float64(0.0)
    for j in range(matrix.shape[1]):
        total += matrix[i, j] * values[j]
    product[i] = total
