"""`python -m datagen` with the ballistic stand-in for scenes and solver; run with this folder on the path."""

from functools import partial

from ballistic_solver import BALLISTIC

from datagen.__main__ import main
from hgn.command import run_command

if __name__ == "__main__":
    run_command(partial(main, backend=BALLISTIC), "datagen")
