"""Checks and repairs LeRobot datasets."""
