"""The discrete optimal map: least transport cost among maps that keep the areas around vertices (section 4.3)."""

from omtwarp.optimal.map_energy import MapEnergy
from omtwarp.optimal.solver import GAIN, SHAPE_WEIGHT, OptimalMap, optimal_map

__all__ = ["GAIN", "SHAPE_WEIGHT", "MapEnergy", "OptimalMap", "optimal_map"]
