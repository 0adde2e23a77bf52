"""Recipes, the plan of their artifacts, and how these are made: one machine or many."""
