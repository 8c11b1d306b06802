"""From stored results to tables, pictures and TensorBoard: ``famle report``, and what a benchmark prints at its end."""
