"""Runs the command line as ``python -m services``."""

from services.command_line import main

if __name__ == "__main__":
    main()
