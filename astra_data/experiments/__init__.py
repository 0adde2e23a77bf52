"""Recipes, the plan of their artefacts, and how these are made: one machine or many."""
