"""`python -m datagen` with the ballistic stand-in for scenes and solver; run with this folder on the path."""

from __future__ import annotations

from functools import partial

from datagen.__main__ import main
from datagen.worker import Backend
from hgn.command import run_command

BALLISTIC = Backend(
    generate_scene="ballistic_solver:generate_scene",
    build_obstacle_grid="ballistic_solver:build_obstacle_grid",
    simulate="ballistic_solver:simulate",
)

if __name__ == "__main__":
    run_command(partial(main, backend=BALLISTIC), "datagen")
