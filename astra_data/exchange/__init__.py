"""Other people's formats in and out, and datasets shared."""
