"""From a surface to its map: which stages are run, on what, and what is said of the result."""
