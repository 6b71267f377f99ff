"""Command lines of launch files, composed as their commands compose them."""

from collections.abc import Callable
from typing import Any

import hydra
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from hgn.command import _compose
from hgn.config import config_directory

BASES: dict[tuple[str, ...], DictConfig] = {}  # by file and choices of groups


@pytest.fixture
def composed(monkeypatch) -> Callable[[str, list[str]], dict[str, Any]]:
    """Returns what a command is given by its arguments. Hydra reads the files once for each choice of groups; its
    parser reads each setting, as in a composition of its own."""
    whole, parser = hydra.compose, OverridesParser.create()

    def compose(name, overrides):
        conf = config_directory()
        kinds = {path.name for path in conf.iterdir()} if (conf / f"{name}.yaml").exists() else set()
        choices = [text for text in overrides if text[0] in "+~" or text.partition("=")[0] in kinds]
        groups = (name, *choices)
        if groups not in BASES:
            BASES[groups] = whole(name, choices)
        config = BASES[groups].copy()
        for override in parser.parse_overrides([text for text in overrides if text not in choices]):
            OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
        return config

    def composed(command, arguments):
        monkeypatch.setattr("sys.argv", [command, *arguments])
        (mapping,) = _compose(command)
        return mapping

    monkeypatch.setattr(hydra, "compose", compose)
    return composed
