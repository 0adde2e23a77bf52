"""The command line: one thin door per command."""
