"""Section 4.2: Moser's flow, the initial mass-preserving map."""

from omtwarp.moser.flow import MoserMap, moser_map

__all__ = ["MoserMap", "moser_map"]
