"""Sparse symmetric systems on surfaces: Poisson problems and factorisations of matrices on meshes."""
