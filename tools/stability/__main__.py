"""python -m tools.stability PART …: what holds, up to where, and what happens beyond.

Parts are modules of this package with a `main`, each with its options in conf/command/stability_PART.yaml.
"""

from __future__ import annotations

import importlib
import sys

from hgn.command import EXIT_INPUT, run_command

PARTS = ("network", "solver")


def run() -> None:
    """Runs the part that the first argument names."""
    if sys.argv[1:2] in (["--help"], ["-h"]):
        parts = "\n".join(f"  python -m tools.stability {part} --help" for part in PARTS)
        print(f"{__doc__}\n{parts}")
        return
    if len(sys.argv) < 2 or sys.argv[1] not in PARTS:
        found = sys.argv[1] if len(sys.argv) > 1 else "nothing"
        print(f"error: the first argument must be one of {', '.join(PARTS)}, got {found}", file=sys.stderr)
        sys.exit(EXIT_INPUT)
    part = sys.argv.pop(1)
    run_command(importlib.import_module(f"tools.stability.{part}").main, f"stability_{part}")


if __name__ == "__main__":
    run()
