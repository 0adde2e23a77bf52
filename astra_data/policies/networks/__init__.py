"""Networks. They know no environment and no dataset."""
