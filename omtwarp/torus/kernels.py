"""Triangles of a map to the plane: distortion energy, its gradient, and a positive semidefinite Hessian."""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def plane_triangle_distortion(
    corners: wp.array2d[wp.vec2d],
    frames: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    area_weight: wp.float64,
    # Data out:
    energies: wp.array[wp.float64],
    gradients: wp.array2d[wp.float64],
    hessians: wp.array3d[wp.float64],
    ratios: wp.array[wp.float64],
):
    """Angle + λ area distortion of a triangle, weighted, by the coordinates (x0, y0, x1, y1, x2, y2) of its corners.

    With the Jacobian J and its determinant D the energy is |J|² / D + λ (D + 1 / D). Both terms are convex in (J, D);
    the Hessian leaves out the curvature of D, which is not.
    """
    f = wp.tid()
    frame = frames[f]
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    one = frame[0] * (b - a)
    two = frame[1] * (b - a) + frame[2] * (c - a)
    square = wp.dot(one, one) + wp.dot(two, two)
    d = one[0] * two[1] - one[1] * two[0]
    ratios[f] = d
    energies[f] = weights[f] * (square / d - TWO + area_weight * (d + ONE / d - TWO))
    by_ratio = -square / (d * d) + area_weight * (ONE - ONE / (d * d))
    by_ratio_twice = TWO * area_weight / (d * d * d)
    for p in range(6):
        k = p // 2
        first, second = -frame[0], -frame[1] - frame[2]
        if k == 1:
            first, second = frame[0], frame[1]
        elif k == 2:
            first, second = wp.float64(0.0), frame[2]
        x = p - 2 * k
        # Derivatives of the determinant, and of the columns (first and second along the axis x).
        slope = first * two[1] - second * one[1]
        if x == 1:
            slope = second * one[0] - first * two[0]
        gradients[f, p] = weights[f] * (TWO * (first * one[x] + second * two[x]) / d + by_ratio * slope)
        for q in range(6):
            m = q // 2
            first_q, second_q = -frame[0], -frame[1] - frame[2]
            if m == 1:
                first_q, second_q = frame[0], frame[1]
            elif m == 2:
                first_q, second_q = wp.float64(0.0), frame[2]
            y = q - 2 * m
            slope_q = first_q * two[1] - second_q * one[1]
            if y == 1:
                slope_q = second_q * one[0] - first_q * two[0]
            both = wp.float64(0.0)
            if x == y:
                both = first * first_q + second * second_q
            along, along_q = first * one[x] + second * two[x], first_q * one[y] + second_q * two[y]
            mixed = both - (along * slope_q + along_q * slope) / d + square * slope * slope_q / (d * d)
            hessians[f, p, q] = weights[f] * (TWO * mixed / d + by_ratio_twice * slope * slope_q)
