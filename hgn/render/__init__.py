"""Draws pictures of rollouts, and writes files for other programs."""

USD_ENDINGS = (".usdc", ".usda", ".usd")
PLY_ENDING = ".ply"
