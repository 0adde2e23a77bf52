"""Planar worlds: mazes, a point mass, a ball, and the objectives of navigation and kicking."""
