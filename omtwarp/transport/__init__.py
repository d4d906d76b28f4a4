"""Section 4.3: the optimal mass-preserving map, by a Lagrangian flow or by the paper's own scheme.

Nothing is imported here: every map measures its transport cost, and few need the flow's kernels.
"""
