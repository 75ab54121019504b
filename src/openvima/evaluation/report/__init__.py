"""The report of an evaluation: one HTML file."""

from openvima.evaluation.report.page import write_report

__all__ = ["write_report"]
