"""astra-data."""
