"""A policy and an environment for LeRobot's own tools, which import this package by its name.

LeRobot derives the names of modules and classes from that of the configuration.
"""
