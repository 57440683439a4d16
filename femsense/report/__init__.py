"""Reports: the figures and tables of a folder of results as one HTML file that can be mailed and printed."""

from __future__ import annotations

from femsense.report.write import write_report

__all__ = ["write_report"]
