"""Pictures of rollouts, and files for other programs."""

USD_ENDINGS = (".usdc", ".usda", ".usd")
PLY_ENDING = ".ply"
