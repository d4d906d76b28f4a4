"""Maps of many surfaces: one process each, with limits, a record of every item, and resumption."""

from omtwarp.cohort.run import CohortResult, run_cohort
from omtwarp.cohort.tables import Item, read_manifest

__all__ = ["CohortResult", "Item", "read_manifest", "run_cohort"]
