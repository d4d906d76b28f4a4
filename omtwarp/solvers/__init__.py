"""Sparse symmetric systems on surfaces: Poisson problems, the built-in Cholesky factorisation, multigrid."""
