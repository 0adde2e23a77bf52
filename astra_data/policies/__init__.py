"""Environments for policies, learners, and running what they learned."""
