"""Planar worlds: mazes, a point mass, a ball, and the tasks that they share with robots."""
