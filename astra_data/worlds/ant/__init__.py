"""Gymnasium's ant in a maze, and the point mass that stands for it."""
