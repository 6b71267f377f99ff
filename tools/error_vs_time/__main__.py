"""python -m tools.error_vs_time data=… weights=[…] out=results/error_vs_time: error against run time.

Compares networks (by default the shipped ones), the solver on coarser grids and with larger steps, and baselines on
the same test scenes. docs/concepts/judging.md states what the reference is. Writes a table, OUT.json, OUT.png,
OUT_batched.png and OUT_frames.png.
"""

from hgn.command import run_command

if __name__ == "__main__":
    run_command("tools.error_vs_time.command", "error_vs_time")
