"""python -m tools.stability PART …: checks a network or the solver, and finds limits.

Parts are modules of this package with a `main`, each with its options in conf/command/stability_PART.yaml.
"""

import sys

from hgn.command import EXIT_INPUT, run_command

PARTS = ("network", "solver")


def run() -> None:
    """Runs the part that the first argument names."""
    part = next(iter(sys.argv[1:]), "nothing")
    if part in ("--help", "-h"):
        print(__doc__, *(f"  python -m tools.stability {part} --help" for part in PARTS), sep="\n")
        return
    if part not in PARTS:
        print(f"error: the first argument must be one of {', '.join(PARTS)}, got {part}", file=sys.stderr)
        sys.exit(EXIT_INPUT)
    del sys.argv[1]
    run_command(f"tools.stability.{part}", f"stability_{part}")


if __name__ == "__main__":
    run()
