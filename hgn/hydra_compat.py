"""Contains all uses of Hydra, including private and fragile parts; pyproject.toml bounds its version.

`tests/test_hydra_compat.py` fails if a new version has changed one of them.
"""

import argparse
import codecs
import importlib
import itertools
import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from hgn.schema import ConfigError, default_mapping, known_keys, require
from hgn.system.yaml_files import read_yaml

OPTIONS = (
    *("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--resolve", "--package", "-p", "--run", "-r"),
    *("--multirun", "-m", "--shell-completion", "-sc", "--config-path", "-cp", "--config-name", "-cn", "--config-dir"),
    *("-cd", "--experimental-rerun", "--info", "-i"),
)

# Hydra creates no folder and no log file. Each command chooses where it writes.
_QUIET = ("hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=none", "hydra/hydra_logging=none")
_DATACLASS = re.compile(r"(?:hgn|datagen|tools)(?:\.\w+)+\.[A-Z]\w*Config")


def compose(folder: Path, config_name: str, arguments: list[str], complete: bool = True) -> list[dict[str, Any]]:
    """Returns the composed configurations as plain containers, several with --multirun. `arguments` are as `sys.argv`.

    A file whose `defaults` name a dataclass, as hgn.config.NetworkConfig, starts with the defaults of this class.
    Hydra's own entry point is slow: it composes twice and reads its callers' sources. Only Hydra's options need it.
    Raises ConfigError, also for a missing key if the configuration must be `complete`.
    """
    from hydra import compose as compose_once
    from hydra import initialize_config_dir
    from hydra import main as hydra_main
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    _check_options(arguments[1:])
    arguments = [arguments[0], *(_override(argument, folder) for argument in arguments[1:])]
    given, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    composed: list[Any] = []
    try:
        if any(argument.lstrip("+").startswith(("-", "hydra")) for argument in arguments[1:]):
            sys.argv = _with_quiet(arguments)
            os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra would print the error and exit
            with _strict_files(), registered_dataclasses(folder, config_name), warnings.catch_warnings():
                warnings.simplefilter("error", UserWarning)  # Hydra warns of folders that do not exist
                hydra_main(version_base="1.3", config_path=str(folder), config_name=config_name)(composed.append)()
        else:
            with (
                _strict_files(),
                registered_dataclasses(folder, config_name),
                initialize_config_dir(str(folder), version_base="1.3"),  # last: it stays initialised if others fail
            ):
                composed.append(compose_once(config_name, arguments[1:]))
        plain = [OmegaConf.to_container(config, resolve=True, throw_on_missing=complete) for config in composed]
    except SystemExit as end:  # Hydra ends with 1 after a message about a missing package
        sys.exit(2 if end.code else 0)
    except MissingConfigException as error:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        files = [each for each in error.options or () if "." not in each]  # without registered dataclasses
        known = known_keys(name, files, "files")
        known += f"{'' if known.endswith('?') else ';'} --config-dir=DIR adds the files of DIR/{group}"
        text = f"{group} must be a file of conf/{group}, got {name!r}; {known}"
        raise ConfigError(text if files else " ".join(str(error).split())) from error
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key} is missing; it must be given, as in {error.full_key}=…") from error
    except (HydraException, OmegaConfBaseException, ValueError, UserWarning, yaml.YAMLError) as error:  # by Hydra
        text = " ".join(str(error).split("Config search path:")[0].split())
        raise ConfigError(text or _unread(arguments, error)) from error
    except (TypeError, LookupError, AttributeError, AssertionError) as error:  # Hydra's faults with lists' items
        raise ConfigError(_unread(arguments, error)) from error
    except RecursionError:
        raise ConfigError("defaults must not refer back to the same file, got a cycle") from None
    finally:
        sys.argv = given
        os.environ.pop("HYDRA_FULL_ERROR", None)
        if full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = full_error
    result = [{str(key): value for key, value in dict(mapping).items()} for mapping in plain]  # type: ignore[arg-type]
    if any(isinstance(mapping.get("experiment"), dict) for mapping in result):
        raise ConfigError("files of experiments must begin with the line '# @package _global_', got one without")
    return result


def _unread(arguments: list[str], error: Exception) -> str:
    given = f"{' '.join(arguments[1:])} ({type(error).__name__}: {error})"
    return f"settings must follow Hydra's syntax, got {given}; check lists, their numbers, and ${{…}}"


@contextmanager
def _strict_files() -> Iterator[None]:
    """Makes Hydra read files as `read_yaml` does. Hydra ignores lists and byte order marks, and misreads numbers."""
    from hydra._internal.sources_registry import SourcesRegistry
    from hydra.core.plugins import Plugins

    Plugins.instance()  # fills the registry
    files: Any = SourcesRegistry.instance().resolve("file")
    load = files.load_config

    def load_strictly(source: Any, config_path: str) -> Any:
        file = Path(source.path, source._normalize_file_name(config_path))
        if file.is_file():
            if file.read_bytes().startswith(codecs.BOM_UTF8):
                raise ConfigError(f"{file} must be UTF-8 without a byte order mark; save it as such")
            if not isinstance(content := read_yaml(file), dict | None):
                raise ConfigError(f"{file} must be a mapping of keys to values, got {content!r:.60}")
        return load(source, config_path)

    files.load_config = load_strictly
    try:
        yield
    finally:
        files.load_config = load


def _check_options(arguments: list[str]) -> None:
    """Raises ConfigError for wrong values of Hydra's options. Hydra would print a whole page."""
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.exit_on_error = False
    try:
        given, apart = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise ConfigError(f"Hydra's options must have the form --cfg job, got {error}") from None
    if apart:
        rule = "settings must be consecutive"
        raise ConfigError(f"{rule}, got {' '.join(apart)} separately; put all before or after Hydra's options")
    folder = given.config_dir
    require(folder is None or Path(folder).is_dir(), "--config-dir", "an existing folder", folder)


def dataclass_of(file: Path) -> type | None:
    """Returns the dataclass that a file's `defaults` name, or None."""
    names = _dataclasses_in(file)
    return _load(names[0]) if names else None


def _dataclasses_in(file: Path) -> list[str]:
    """Returns the dotted names in the `defaults` of a file."""
    defaults = re.search(r"^defaults:(.*(?:\n +-.*|\n *#.*)*)", file.read_text(encoding="utf-8"), re.MULTILINE)
    return _DATACLASS.findall(defaults[1]) if defaults else []


def _load(name: str) -> type:
    module, _, leaf = name.rpartition(".")
    loaded: type = getattr(importlib.import_module(module), leaf)
    return loaded


@contextmanager
def registered_dataclasses(folder: Path, config_name: str) -> Iterator[None]:
    """Registers the dataclasses that config files name with Hydra, under these names.

    Hydra's store is global, so it is restored at the end. Otherwise the next command would have these groups too.
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
    """Returns an argument in Hydra's syntax.
    Unknown keys are added, so that the command refuses them and names its keys. experiment=… becomes +experiment=….
    Values are quoted where necessary."""
    key, equals, value = argument.partition("=")
    if not equals or key.startswith("-"):
        return argument
    # Hydra would parse the file's name; Path.is_file raises an error for a long list
    if re.search(r"^ |[\[{$,'\"(]", value) and os.path.isfile(value):  # noqa: PTH113
        value = "'" + value.replace("'", "\\'").replace("${", "\\${") + "'"
    elif value and not _understood(value):
        value = _in_quotes(value)
    name = key.lstrip("+")
    if value in ("[]", "null") and (name == "experiment" or (folder / name).is_dir()):
        raise ConfigError(f"{name} must be a file of conf/{name}, or several, got {value}; leave it out for none")
    if name == "experiment":
        key = "+experiment"
    elif re.fullmatch(r"(?!hydra)[A-Za-z][\w.]*", key) and not (folder / key).is_dir():  # the key is not a group
        key = f"++{key}"
    return f"{key}={value}"


def _in_quotes(value: str) -> str:
    """Returns a value with quotes if Hydra's grammar refuses it (with ü, &, # or (1) in it), also in a flat list.
    ~/ becomes the home folder. The value stays unchanged if quotes do not help."""
    if value[0] == "[" and value[-1] == "]" and not re.search("[\"'{}[\\]]", value[1:-1]):
        items = [item.strip() for item in value[1:-1].split(",")]
        return f"[{','.join(_in_quotes(item) if item and not _understood(item) else item for item in items)}]"
    meant = str(Path(value).expanduser()) if value.startswith("~/") else value
    quoted = "'" + re.sub(r"(\\*)('|$)", lambda end: end[1] * 2 + end[2].replace("'", "\\'"), meant) + "'"
    return quoted if value[0] not in "\"'[{" and _understood(quoted) == [meant] else value


def _understood(value: str) -> list[Any]:
    """Returns [value] as Hydra parses it, or [] for a value that its grammar refuses."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return [OverridesParser.create().parse_override(f"key={value}").value()]
    except HydraException:
        return []


def _with_quiet(arguments: list[str]) -> list[str]:
    # These go directly before the user's overrides: later ones win, and argparse accepts only one sequence.
    for place, (before, argument) in enumerate(itertools.pairwise(arguments), 1):
        override = "=" in argument and not argument.startswith("-")
        if override and ("=" in before or not before.startswith("--conf")):
            return [*arguments[:place], *_QUIET, *arguments[place:]]
    return [*arguments, *_QUIET]
