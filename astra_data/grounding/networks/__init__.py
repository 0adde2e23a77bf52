"""Networks of the grounding."""
