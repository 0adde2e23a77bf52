"""Finds what is wrong with a LeRobot dataset, and mends what can be mended."""
