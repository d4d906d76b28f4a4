"""Finding and preventing flipped triangles: exact predicates and a guard for steps."""
