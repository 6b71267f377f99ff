"""All of Hydra that the commands use, its private and fragile parts included; pyproject.toml bounds its version.

`tests/test_hydra_compat.py` fails when a new version has changed one of them.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hgn.renamed import CHOICES, REMOVED_CHOICES
from hgn.schema import ConfigError, default_mapping

OPTIONS = (
    *("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--resolve", "--package", "-p", "--run", "-r"),
    *("--multirun", "-m", "--shell-completion", "-sc", "--config-path", "-cp", "--config-name", "-cn", "--config-dir"),
    *("-cd", "--experimental-rerun", "--info", "-i"),
)

# Hydra makes no folder and no log file of its own; the commands say where they write
_QUIET = (
    "hydra.run.dir=.",
    "hydra.output_subdir=null",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
)
_DATACLASS = re.compile(r"(?:hgn|datagen|tools)(?:\.\w+)+\.[A-Z]\w*Config")


def compose(folder: Path, config_name: str, arguments: list[str], complete: bool = True) -> list[dict[str, Any]]:
    """The composed configuration as plain containers, or several with --multirun; arguments are those of `sys.argv`.

    A file whose `defaults` name a dataclass, as in hgn.config.NetworkConfig, begins with that one's defaults. Where no
    option asks for more, Hydra composes once: its own entry point does so twice, and reads the sources of its callers.
    Raises: ConfigError, also where a key that must be given lacks, and the configuration is to be `complete`.
    """
    from hydra import compose as compose_once
    from hydra import initialize_config_dir
    from hydra import main as hydra_main
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    arguments = [arguments[0], *(_override(argument, folder) for argument in arguments[1:])]
    given, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    composed: list[Any] = []
    try:
        if any(argument.lstrip("+~").startswith(("-", "hydra")) for argument in arguments[1:]):
            sys.argv = _with_quiet(arguments)
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra would print and exit itself otherwise
            with registered_dataclasses(folder, config_name):
                hydra_main(version_base="1.3", config_path=str(folder), config_name=config_name)(composed.append)()
        else:
            with registered_dataclasses(folder, config_name), initialize_config_dir(str(folder), version_base="1.3"):
                composed.append(compose_once(config_name, arguments[1:]))
        plain = [OmegaConf.to_container(config, resolve=True, throw_on_missing=complete) for config in composed]
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key} is missing; it must be given, as in {error.full_key}=…") from error
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # Hydra raises plain ValueErrors too
        raise ConfigError(" ".join(str(error).split("Config search path:")[0].split())) from error
    finally:
        sys.argv = given
        os.environ.pop("HYDRA_FULL_ERROR", None)
        if full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = full_error
    return [{str(key): value for key, value in dict(mapping).items()} for mapping in plain]  # type: ignore[arg-type]


def dataclass_of(file: Path) -> type | None:
    """The dataclass that a file's `defaults` name; none where they name none."""
    names = _dataclasses_in(file)
    return _load(names[0]) if names else None


def _dataclasses_in(file: Path) -> list[str]:
    """Dotted names in the `defaults` of a file."""
    defaults = re.search(r"^defaults:(.*(?:\n +-.*|\n *#.*)*)", file.read_text(encoding="utf-8"), re.MULTILINE)
    return _DATACLASS.findall(defaults[1]) if defaults else []


def _load(name: str) -> type:
    module, _, leaf = name.rpartition(".")
    loaded: type = getattr(importlib.import_module(module), leaf)
    return loaded


@contextmanager
def registered_dataclasses(folder: Path, config_name: str) -> Iterator[None]:
    """While entered, Hydra knows the defaults of the dataclasses that config files name, under those names.

    Hydra's store is one for the process, and a group that another command has would be a group here.
    """
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    before = dict(store.repo)
    primary = folder / f"{config_name}.yaml"
    choices = [file for file in folder.glob("*/*.yaml") if file.parent.name != "command"]
    for file in [*([primary] if primary.is_file() else []), *choices]:
        for name in _dataclasses_in(file):
            store.store(name, default_mapping(_load(name)), None if file == primary else file.parent.name)
    try:
        yield
    finally:
        store.repo = before


def _override(argument: str, folder: Path) -> str:
    """An argument as Hydra is to get it: a key that it does not find is added, so that the command itself refuses it
    and names the keys that it knows; experiment=… is as good as +experiment=…; values are quoted where they must be."""
    key, equals, value = argument.partition("=")
    if not equals or key.startswith("-"):
        return argument
    if new := CHOICES.get(argument.lstrip("+")):
        raise ConfigError(f"{argument} is called {new} now")
    if remedy := REMOVED_CHOICES.get(key.lstrip("+"), {}).get(value):
        raise ConfigError(f"{argument} was removed; {remedy}")
    if value and not _understood(value):
        value = _in_quotes(value)
    if re.fullmatch(r"[A-Za-z][\w.]*", key) and not key.startswith("hydra"):
        if key == "experiment":
            key = "+experiment"
        elif not (folder / key).is_dir():  # no choice of a group
            key = f"++{key}"
    return f"{key}={value}"


def _in_quotes(value: str) -> str:
    """A value that Hydra's grammar refuses as it is, or such values of a flat list, in quotes: names with ü, &, # or
    (1) in them, say, and ~/, which is the home folder. Unchanged where they are no help."""
    if value[0] == "[" and value[-1] == "]" and not re.search("[\"'{}[\\]]", value[1:-1]):
        items = [item.strip() for item in value[1:-1].split(",")]
        return f"[{','.join(_in_quotes(item) if item and not _understood(item) else item for item in items)}]"
    meant = str(Path(value).expanduser()) if value.startswith("~/") else value
    quoted = "'" + re.sub(r"(\\*)('|$)", lambda end: end[1] * 2 + end[2].replace("'", "\\'"), meant) + "'"
    return quoted if value[0] not in "\"'[{" and _understood(quoted) == [meant] else value


def _understood(value: str) -> list[Any]:
    """What Hydra takes a value for, alone in a list; an empty one for what its grammar refuses."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return [OverridesParser.create().parse_override(f"key={value}").value()]
    except HydraException:
        return []


def _with_quiet(arguments: list[str]) -> list[str]:
    # before the person's own overrides, so that theirs win, and beside them, because argparse takes overrides in one
    # run only
    for place, argument in enumerate(arguments):
        if place and "=" in argument and not argument.startswith("-") and not arguments[place - 1].startswith("--conf"):
            return [*arguments[:place], *_QUIET, *arguments[place:]]
    return [*arguments, *_QUIET]
