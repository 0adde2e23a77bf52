"""From pairs to a corrected simulator: fit, simulate, measure."""
