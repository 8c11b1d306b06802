"""What has nothing to do with robots."""
