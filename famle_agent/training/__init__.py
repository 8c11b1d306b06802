"""Algorithm 1: how a model is meta-learned."""
