"""Command lines composed as Hydra composes them, which reads the files once for each choice of groups."""

import copy
from pathlib import Path
from typing import Any

from hydra import compose as compose_files
from hydra._internal import config_loader_impl as loader
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


def read_once():
    """Makes commands in this process read the files of conf/ once for each choice of groups: Hydra takes 0.1 s for it.

    Settings of the command line are parsed and merged each time; other folders are read as ever."""
    lists: dict[Any, Any] = {}
    merged: dict[int, DictConfig] = {}
    list_defaults, merge = loader.create_defaults_list, loader.ConfigLoaderImpl._compose_config_from_defaults_list
    conf = Path(__file__).parents[1] / "conf"
    folders = {(f"file://{folder}", "main") for folder in (conf, conf / "command")}

    def lists_once(repo, config_name, overrides_list, prepend_hydra, skip_missing):
        given = [each for each in overrides_list if not each.is_sweep_override()]
        groups = [o for o in given if repo.group_exists(o.key_or_group) and not isinstance(o.value(), dict)]
        sources = {(source.full_path(), source.provider) for source in repo.get_sources()}
        key = (frozenset(sources), config_name, prepend_hydra, skip_missing, *(each.input_line for each in groups))
        if not any(source in folders for source in sources) or len(sources) > 3:
            return list_defaults(repo, config_name, overrides_list, prepend_hydra, skip_missing)
        if key not in lists:
            lists[key] = list_defaults(repo, config_name, groups, prepend_hydra, skip_missing)
        found = copy.copy(lists[key])
        found.config_overrides = [each for each in given if each not in groups]
        return found

    def merge_once(self, defaults, repo):
        if not any(defaults is each.defaults for each in lists.values()):
            return merge(self, defaults, repo)
        if id(defaults) not in merged:
            merged[id(defaults)] = merge(self, defaults, repo)
        return copy.deepcopy(merged[id(defaults)])

    def share_sources(self, delegate):
        self.delegate, self.cache = copy.copy(delegate), {}  # whose list of sources is replaced, not changed

    loader.create_defaults_list = lists_once
    loader.CachingConfigRepository.__init__ = share_sources
    loader.ConfigLoaderImpl._compose_config_from_defaults_list = merge_once
