"""Draws pictures of rollouts, and writes files for other programs."""

PLY_ENDING = ".ply"
