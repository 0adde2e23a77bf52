"""Results of a recipe: artifacts of its runs → one tidy table (`results`), figures and pages."""
