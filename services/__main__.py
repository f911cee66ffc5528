"""Runs the command line as ``python -m services``."""

from services.cli.main import main

if __name__ == "__main__":
    main()
