"""Runs control as a process of its own."""

from kouxing.services.process import run_module

if __name__ == "__main__":
    run_module("control")
