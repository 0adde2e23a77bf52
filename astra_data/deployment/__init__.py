"""Trained policies as folders that run without this package."""
