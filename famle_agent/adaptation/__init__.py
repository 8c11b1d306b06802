"""Algorithm 2: how a model is adapted and planned with."""
