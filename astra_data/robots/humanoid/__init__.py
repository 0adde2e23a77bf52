"""Gymnasium's humanoid under four joint commands, with three abstract simulators."""
