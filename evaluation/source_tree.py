"""Paths in the source tree. In an installed package, only the sample exists."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]  # root of the source tree, behind its links
SAMPLE = ROOT / "shared" / "demo" / "hello-female.wav"
