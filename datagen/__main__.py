"""`python -m datagen +experiment=obstacles scenes=800 out=data/obstacles`: generates or completes a data set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hgn.command import run_command

if TYPE_CHECKING:
    from datagen.pool.worker import Backend


def main(mapping: dict[str, Any], backend: Backend | None = None) -> int:
    """Runs the generator on a composed config. The exit code is 0, or 128 + the signal that stopped it."""
    from datagen.generate import datagen_config, generate, stop_signals
    from datagen.pool.progress import make_progress

    kind = mapping.get("progress", "bar")
    progress = make_progress(kind)
    config = datagen_config(mapping)
    with stop_signals() as stop:
        # a training that waits for the first episodes reads progress=json
        finished = generate(config, progress, lambda: stop.requested, backend, early=kind == "json")
    return 0 if finished else stop.exit_code


if __name__ == "__main__":
    run_command(main, "datagen")
