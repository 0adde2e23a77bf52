"""Gymnasium's ant in a maze, its low-level controller, and its tasks."""
