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
    added = [text for text in overrides if text[0] in "+~" and not text.startswith("++")]
    choices = [text for text in overrides if text in added or text.partition("=")[0] in kinds]
    groups = (name, *choices)
    if groups not in BASES:
        with registered_dataclasses(folder, name):
            BASES[groups] = compose_files(name, choices)
    config = BASES[groups].copy()
    for override in PARSER.parse_overrides([text for text in overrides if text not in choices]):
        key, new = override.key_or_group, override.is_force_add()
        OmegaConf.update(config, key, override.value(), merge=True, force_add=new)
    return config
