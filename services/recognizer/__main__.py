"""Runs a recognizer in its own process."""

from kouxing.services.process import run_module

if __name__ == "__main__":
    run_module("recognizer")
