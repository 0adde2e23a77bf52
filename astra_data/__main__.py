"""`python -m astra_data` is the command `astra-data`."""

from astra_data.cli.app import main

if __name__ == "__main__":
    main()
