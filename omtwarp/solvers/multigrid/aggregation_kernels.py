"""Kernels that group the nodes of a graph and colour them: one thread each, once for every level, on the CPU."""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def aggregate_nodes(
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    # Data out:
    aggregates: wp.array[wp.int32],
    count: wp.array[wp.int32],
):
    """Compute the aggregates of Vaněk, Mandel and Brezina (1996), in the order of the nodes.

    A node without a neighbour in an aggregate founds one with all its neighbours. The remaining nodes join the founded
    aggregate that they are most strongly connected to; those without one form aggregates with one another.
    """
    size = aggregates.shape[0]
    total = int(0)
    for i in range(size):
        aggregates[i] = wp.int32(-1)
    for i in range(size):
        alone = aggregates[i] < 0 and offsets[i + 1] > offsets[i]
        if alone:
            for k in range(offsets[i], offsets[i + 1]):
                if aggregates[columns[k]] >= 0:
                    alone = False
        if alone:
            aggregates[i] = total
            for k in range(offsets[i], offsets[i + 1]):
                aggregates[columns[k]] = total
            total += 1
    # Joiners are marked by -2 - a, so that none of them counts as founded while others still choose.
    for i in range(size):
        if aggregates[i] == -1:
            largest = wp.float64(-1.0)
            chosen = int(-1)
            for k in range(offsets[i], offsets[i + 1]):
                if aggregates[columns[k]] >= 0 and weights[k] > largest:
                    largest = weights[k]
                    chosen = int(aggregates[columns[k]])
            if chosen >= 0:
                aggregates[i] = wp.int32(-2 - chosen)
    for i in range(size):
        if aggregates[i] < -1:
            aggregates[i] = wp.int32(-2 - aggregates[i])
    for i in range(size):
        if aggregates[i] == -1:
            aggregates[i] = total
            for k in range(offsets[i], offsets[i + 1]):
                if aggregates[columns[k]] == -1:
                    aggregates[columns[k]] = total
            total += 1
    count[0] = total


@wp.kernel
def colour_nodes(
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    # Data out:
    colours: wp.array[wp.int32],
):
    """Compute the first colour that no neighbour has, node by node."""
    size = colours.shape[0]
    for i in range(size):
        colours[i] = wp.int32(-1)
    for i in range(size):
        colour = int(0)
        k = offsets[i]
        while k < offsets[i + 1]:
            if columns[k] != i and colours[columns[k]] == colour:
                colour += 1
                k = offsets[i]
            else:
                k += 1
        colours[i] = colour
