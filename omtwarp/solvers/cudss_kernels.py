"""Kernels that assemble matrices for cuDSS."""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def gather_entries(
    given: wp.array[wp.float64],
    source: wp.array[wp.int32],
    # Data out:
    entries_out: wp.array[wp.float64],
):
    """Take every entry of a sparse matrix from its place in a list of blocks."""
    i = wp.tid()
    entries_out[i] = given[source[i]]
