"""Command lines composed as Hydra composes them, which reads the files once for each choice of groups."""

from typing import Any

from hydra import compose as compose_files
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from hgn.hydra_compat import registered_dataclasses

BASES: dict[tuple[str, ...], DictConfig] = {}  # by file and choices of groups
PARSER: Any = OverridesParser.create()


def compose(folder, name, overrides):
    """The configuration of a file in a folder with these overrides; Hydra's parser reads each setting."""
    kinds = {path.name for path in folder.iterdir() if path.is_dir()}
    choices = [text for text in overrides if text[0] in "+~" or text.partition("=")[0] in kinds]
    groups = (name, *choices)
    if groups not in BASES:
        with registered_dataclasses(folder, name):
            BASES[groups] = compose_files(name, choices)
    config = BASES[groups].copy()
    for override in PARSER.parse_overrides([text for text in overrides if text not in choices]):
        OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
    return config
