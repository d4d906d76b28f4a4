"""A map to start from, also where the conformal map does not exist in float64."""
