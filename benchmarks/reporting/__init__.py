"""From stored results to tables and pictures: ``python -m benchmarks.reporting``."""
