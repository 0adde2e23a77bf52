"""Foundations of all other rooms; nothing here knows robots or datasets."""
