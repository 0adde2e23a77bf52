"""Environments to train policies in, and trained policies in action."""
