"""The start of the pipeline, also where the conformal map cannot be represented in float64."""
