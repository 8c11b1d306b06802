"""From stored results to tables, pictures and TensorBoard: ``python -m benchmarks.reporting``."""
