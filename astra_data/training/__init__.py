"""Environments for policies, and policies at work."""
