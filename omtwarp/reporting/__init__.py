"""The report page: one self-contained HTML file about a map.

Names are imported at their first use, so that importing the package does not start Warp.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omtwarp.reporting.page import report_page as report_page, write_report as write_report

__all__ = ["report_page", "write_report"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module("omtwarp.reporting.page"), name)
