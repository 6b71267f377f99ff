"""python -m tools.scaling [json=FILE]: weak scaling of training on this machine's devices.

A contender is timed only if it passes its check. The JSON contains {"meta": provenance, "rows"}.
"""

from hgn.command import run_command

if __name__ == "__main__":
    run_command("tools.scaling.command", "scaling")
