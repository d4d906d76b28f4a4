"""A triangle's energy, frames, the Newton matrix and the line search: shared by untangling and refinement."""
