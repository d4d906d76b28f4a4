"""The discrete optimal map: least transport cost among maps that keep the areas around vertices (section 4.3)."""

from omtwarp.optimal.energy import SHAPE_WEIGHT
from omtwarp.optimal.solver import GAIN, OptimalMap, optimal_map
from omtwarp.optimal.sphere import MapEnergy

__all__ = ["GAIN", "SHAPE_WEIGHT", "MapEnergy", "OptimalMap", "optimal_map"]
