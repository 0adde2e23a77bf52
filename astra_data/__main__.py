"""`python -m astra_data` is the command `astra-data`."""

from astra_data.cli.app import main

main()
