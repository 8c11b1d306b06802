"""Transitions, and what collects them."""
