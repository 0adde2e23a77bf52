"""Planar worlds: mazes, a point mass, navigation, and episodes placed elsewhere."""
