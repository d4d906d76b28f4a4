"""The report page: one self-contained HTML file about a map.

Names are imported at their first use, so that importing the package does not start Warp.
"""

from typing import TYPE_CHECKING

from omtwarp import _at_first_use

if TYPE_CHECKING:
    from omtwarp.reporting.page import report_page as report_page, write_report as write_report

__all__, __getattr__, __dir__ = _at_first_use(__name__)
