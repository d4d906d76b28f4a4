"""Finished maps of surfaces, and their files."""
