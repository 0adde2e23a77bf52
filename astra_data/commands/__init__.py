"""Commands that work on any dataset; each a thin door to a function of the same name."""
