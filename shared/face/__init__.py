"""MPEG-4 FAPs, ``.fap`` files, idle motion, and blendshapes as sums of FAPs."""
