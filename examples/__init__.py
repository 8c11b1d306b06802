"""Robots of your own: scripts to copy."""
