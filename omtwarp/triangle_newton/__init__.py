"""What untangling and refinement share: a triangle's energy, frames, the Newton matrix, line search."""
