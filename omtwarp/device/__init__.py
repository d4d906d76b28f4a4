"""Where kernels run: Warp's start, arrays, sums, recorded graphs, threads and memory."""
