"""Maps of many surfaces: one process each, with limits, a record of every item, and resumption."""

from omtwarp.cohort.manifest import Item, read_manifest
from omtwarp.cohort.run import CohortResult, run_cohort

__all__ = ["CohortResult", "Item", "read_manifest", "run_cohort"]
