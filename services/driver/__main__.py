"""Runs the driver as a process of its own."""

import sys

from services.command_line import main

if __name__ == "__main__":
    sys.argv.insert(1, "driver")
    main()
