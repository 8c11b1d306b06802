"""``python -m benchmarks.reporting``: the report on all stored results."""

from benchmarks import command
from benchmarks.reporting.report import Report

if __name__ == "__main__":
    command.run(Report.__call__, Report)
