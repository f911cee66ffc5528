"""MPEG-4 FAPs, their files, and blendshapes as sums of FAPs."""
