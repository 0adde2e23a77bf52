"""Robots that come with the package: bodies, targets, simulators and tasks."""
