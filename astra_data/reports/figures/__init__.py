"""Figures of reports and cards, one kind a file."""
