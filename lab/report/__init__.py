"""The report of a run, and the index of a batch: HTML files that open without a network."""

from lab.report.page import write_report

__all__ = ["write_report"]
