"""``python -m benchmarks.reporting``: the report on all stored results."""

from benchmarks.reporting.report import Report
from benchmarks.runner import launch

if __name__ == "__main__":
    launch(Report.__call__, Report)
