"""The kernel that computes what the distortion of a map sums up."""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, wp
from omtwarp.mesh import surface

wp.set_module_options(KERNEL_OPTIONS)

SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))  # of the unit sphere, 4π


@wp.kernel
def distortion_summands(
    ratio: wp.array[wp.float64],
    total: wp.array[wp.float64],
    # Data out:
    excess: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
):
    """Compute r + 1/r - 2 without cancellation, r the area ratio scaled by the image's total area, and 1/ratio.

    Neither is multiplied by the areas yet.
    """
    t = wp.tid()
    scaled = SPHERE_AREA / total[0] * ratio[t]
    excess[t] = (scaled - ONE) * (scaled - ONE) / scaled
    inverse[t] = ONE / ratio[t]
