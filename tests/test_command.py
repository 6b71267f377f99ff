"""The configuration of a command, composed once, is what Hydra's own entry point would hand over."""

from __future__ import annotations

import pytest

from hgn.command import _compose


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("datagen", ["+experiment=demo", "dataset.frames=7", "scene.materials=[sand]"]),
        ("train", ["+experiment=small", "training.batch_scenes=2", "run=runs/x"]),
        ("stability_network", ["cases=[long]"]),
    ],
)
def test_composed_once(command: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """An option of Hydra's makes it compose in its own way, with the same result."""
    monkeypatch.setattr("sys.argv", [command, *arguments])
    once = _compose(command)
    monkeypatch.setattr("sys.argv", [command, *arguments, "hydra.job.name=x"])
    assert _compose(command) == once and len(once) == 1
