"""python -m tools.bench [json=FILE]: times of a frame, a training step and the solver.

A contender is timed only if it passes its check. The JSON contains {"meta": provenance, "rows": [...]}.
"""

from hgn.command import run_command

if __name__ == "__main__":
    run_command("tools.bench.command", "bench")
