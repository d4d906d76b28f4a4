"""Maps of surfaces with a boundary: to a hemisphere, and from there to a disk or a spherical cap."""
