"""FAMLE and its baselines, with the face of Stable-Baselines3."""
