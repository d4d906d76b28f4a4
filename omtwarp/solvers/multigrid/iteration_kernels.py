"""Kernels of conjugate gradients whose scalars stay on the device; they finish the sums that they need."""

from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ZERO, wp
from omtwarp.device.sum_kernels import column_sum

wp.set_module_options(KERNEL_OPTIONS)

# Places of the scalars of an iteration.
ENERGY = wp.constant(0)  # r · z
ALPHA = wp.constant(1)
BETA = wp.constant(2)
TARGET = wp.constant(3)  # what r · z has to fall below
# Places of its counters.
ACTIVE = wp.constant(0)
DONE = wp.constant(1)
BROKEN = wp.constant(2)


@wp.kernel
def cg_start(
    products: wp.array2d[wp.float64],
    tolerance: wp.array[wp.float64],
    # Data out:
    scalars: wp.array[wp.float64],
    counters: wp.array[wp.int32],
):
    """Store r · z of the start, and stop at once where it is zero."""
    energy = column_sum(products, 0)
    scalars[ENERGY] = energy
    scalars[TARGET] = tolerance[0] * tolerance[0] * energy
    counters[ACTIVE] = wp.int32(0)
    counters[DONE] = wp.int32(0)
    counters[BROKEN] = wp.int32(0)
    if energy > ZERO and energy < LARGE:
        counters[ACTIVE] = wp.int32(1)
    elif not (energy == ZERO):
        counters[BROKEN] = wp.int32(1)


@wp.kernel
def cg_alpha(
    products: wp.array2d[wp.float64],
    # Data in and out:
    scalars: wp.array[wp.float64],
    counters: wp.array[wp.int32],
):
    """Compute the step to the minimum along the direction, from p · A p.

    There is none where the matrix is not positive along it.
    """
    curvature = column_sum(products, 0)
    scalars[ALPHA] = ZERO
    if counters[ACTIVE] > 0:
        if curvature > ZERO and curvature < LARGE:
            scalars[ALPHA] = scalars[ENERGY] / curvature
        else:
            counters[ACTIVE] = wp.int32(0)
            counters[BROKEN] = wp.int32(1)


@wp.kernel
def cg_advance(
    scalars: wp.array[wp.float64],
    direction: wp.array[wp.float64],
    image: wp.array[wp.float64],
    # Data in and out:
    x: wp.array[wp.float64],
    residual: wp.array[wp.float64],
):
    i = wp.tid()
    x[i] = x[i] + scalars[ALPHA] * direction[i]
    residual[i] = residual[i] - scalars[ALPHA] * image[i]


@wp.kernel
def cg_beta(
    products: wp.array2d[wp.float64],
    most: int,
    # Data in and out:
    scalars: wp.array[wp.float64],
    counters: wp.array[wp.int32],
):
    """Compute the share of the last direction in the next one from the new r · z, and whether there is a next one."""
    energy = column_sum(products, 0)
    scalars[BETA] = ZERO
    if counters[ACTIVE] > 0:
        scalars[BETA] = energy / scalars[ENERGY]
        scalars[ENERGY] = energy
        counters[DONE] = counters[DONE] + 1
        # Written so that a NaN ends the iteration and counts as broken.
        if energy > scalars[TARGET]:
            if counters[DONE] >= most:
                counters[ACTIVE] = wp.int32(0)
                counters[BROKEN] = wp.int32(1)
        else:
            counters[ACTIVE] = wp.int32(0)
            if not (energy >= ZERO):
                counters[BROKEN] = wp.int32(1)


@wp.kernel
def cg_direction(
    scalars: wp.array[wp.float64],
    smoothed: wp.array[wp.float64],
    # Data in and out:
    direction: wp.array[wp.float64],
):
    i = wp.tid()
    direction[i] = smoothed[i] + scalars[BETA] * direction[i]
