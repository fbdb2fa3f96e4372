"""The report of a scan: one self-contained HTML file with verdict, figures, a 3-D view and tables."""

from scanner.report.page import render

__all__ = ["render"]
