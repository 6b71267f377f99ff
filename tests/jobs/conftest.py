"""Command lines of launch files, composed as their commands compose them."""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import hydra
import pytest
from composition import compose

from hgn import hydra_compat
from hgn.command import _compose, _folder


@pytest.fixture
def composed(monkeypatch) -> Callable[[str, list[str]], dict[str, Any]]:
    """Returns what a command is given by its arguments."""

    def composed(command, arguments):
        monkeypatch.setattr("sys.argv", [command, *arguments])
        (mapping,) = _compose(command)
        return mapping

    monkeypatch.setattr(hydra_compat, "registered_dataclasses", lambda *_: nullcontext())
    monkeypatch.setattr(hydra, "compose", lambda name, overrides: compose(_folder(name), name, overrides))
    return composed
