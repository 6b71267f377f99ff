"""What all commands share: Hydra composes the config, and faults a person can mend end in one line, no traceback.

Exit codes: 0 done, 1 the machine is at fault (a full disk, no permission, a path that is taken), 2 the input is at
fault, 130 Ctrl-C, 141 nobody reads any more what it prints (as in `… | head`).
"""

from __future__ import annotations

import errno
import itertools
import os
import re
import select
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from hgn.config import config_directory
from hgn.schema import ConfigError, known_keys, require
from hgn.system.extras import missing_extra

EXIT_MACHINE, EXIT_INPUT, EXIT_INTERRUPTED, EXIT_UNREAD = 1, 2, 130, 141

_HYDRA_OPTIONS = (
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
_MACHINE_ERRORS = {
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space",
    errno.EACCES: "check the permissions",
    errno.EPERM: "check the permissions",
    errno.EROFS: "choose a folder that can be written to",
    # a path the person gave leads through a file, or ends at a thing of the wrong kind
    errno.EEXIST: "choose another path",
    errno.ENOTDIR: "choose another path",
    errno.EISDIR: "choose another path",
    errno.ETIMEDOUT: "see that its server runs",
}


def run_command(main: Callable[[dict[str, Any]], int | None], config_name: str) -> NoReturn:
    """Composes `conf/<config_name>.yaml` with the command line, calls `main` with the plain mapping, and exits.

    A command without config groups has its file in `conf/command/`: beside the groups Hydra would take its keys
    (`scene=my_scene.yaml`) for choices of a group.

    Hydra's own options (--cfg, --config-path, --config-name, --multirun) work as ever, and --help shows such a file
    with its comments. `main` returns an exit code or None for 0. ConfigError, an unknown key and a full disk are
    printed as one line, `error: ...`.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # the process was started without
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 - as long as the process
    code: int | str | None
    try:
        try:
            code = _exit_code(main, config_name)
        except SystemExit as end:  # Hydra's own, after --help
            code = end.code
        sys.stdout.flush()
    except BrokenPipeError:
        if not _unread():
            raise
        for stream in (sys.stdout, sys.stderr):  # what is left in them has nowhere to go when Python ends
            with Path(os.devnull).open("wb") as nowhere:
                os.dup2(nowhere.fileno(), stream.fileno())
        code = EXIT_UNREAD
    sys.exit(code)


def _exit_code(main: Callable[[dict[str, Any]], int | None], config_name: str) -> int:
    file = config_directory() / "command" / f"{config_name}.yaml"
    if sys.argv[1:] in (["--help"], ["-h"]) and file.is_file():
        print(_described(), "", file.read_text(encoding="utf-8"), sep="\n", end="")
        return 0
    try:
        code = 0
        for mapping in _compose(config_name):
            code = main(mapping) or 0
            if code:
                break
    except ConfigError as error:
        code = _fail(str(error), EXIT_INPUT)
    except ModuleNotFoundError as error:
        missing = missing_extra(error)
        if missing is None:
            raise
        code = _fail(missing, EXIT_MACHINE)
    except OSError as error:
        if error.errno not in _MACHINE_ERRORS:
            raise
        place = f": {error.filename}" if error.filename else ""
        remedy = _MACHINE_ERRORS[error.errno]
        code = _fail(f"{error.strerror}{place}; {remedy} and run the same command again to go on", EXIT_MACHINE)
    except KeyboardInterrupt:
        code = _fail("interrupted", EXIT_INTERRUPTED)
    return code


def _unread() -> bool:
    """Whether standard output or error lead into a pipe whose reader has gone."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        poll.register(stream.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def section(mapping: Mapping[str, Any], known: Mapping[str, str | None]) -> dict[str, Any]:
    """Picks a command's own keys out of a composed config, which experiment files share with other commands.

    `known` maps each key that may occur to the dotted name under which it is wanted; None leaves it out. Aliases
    must come after the sections that they write into.
    Raises: ConfigError for a key that is not known.
    """
    for key in mapping:
        if key not in known:
            raise ConfigError(f"{key} is not a known key; {known_keys(str(key), known)}")
    picked: dict[str, Any] = {}
    for key, name in known.items():
        if name is None or key not in mapping:
            continue
        *folders, leaf = name.split(".")
        place = picked
        for folder in folders:
            place = place.setdefault(folder, {})
        value = mapping[key]
        place[leaf] = dict(value) if isinstance(value, Mapping) else value
    return picked


def _compose(config_name: str) -> list[dict[str, Any]]:
    import hydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    folder = config_directory()
    if (folder / "command" / f"{config_name}.yaml").is_file():
        folder = folder / "command"
    composed: list[Any] = []  # one config, or several with --multirun
    arguments, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    quiet = _QUIET + (_help() if "--help" in arguments else ())
    given = _with_json_as_override(arguments)
    _require_options(given)
    sys.argv = _with(quiet, given)
    # Hydra would print and exit itself otherwise
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        run = hydra.main(version_base="1.3", config_path=str(folder), config_name=config_name)(composed.append)
        once = not any(argument.lstrip("+~").startswith(("-", "hydra")) for argument in given[1:])
        while True:
            try:
                if once:
                    composed.append(_composed_once(folder, config_name, sys.argv[1:]))
                else:
                    run()
                break
            except HydraException as error:
                if not _appended(sys.argv, str(error)) and not _quoted(sys.argv):
                    raise
        plain = [OmegaConf.to_container(config, resolve=True, throw_on_missing=True) for config in composed]
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key} is missing; it must be given, as in {error.full_key}=…") from error
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # Hydra raises plain ValueErrors too
        raise ConfigError(_one_line(str(error))) from error
    finally:
        sys.argv = arguments
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error
    return [{str(key): value for key, value in dict(mapping).items()} for mapping in plain]  # type: ignore[arg-type]


def _composed_once(folder: Path, config_name: str, overrides: list[str]) -> Any:
    """What `hydra.main` hands over where no option asks for more; it composes everything twice, first to see whether
    several configs are wanted, and reads the sources of all its callers: a third of a second."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode
    from omegaconf import open_dict

    with initialize_config_dir(str(folder), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        config = hydra.compose_config(config_name, overrides, RunMode.RUN)
    with open_dict(config):
        del config["hydra"]
    return config


def _appended(arguments: list[str], message: str) -> bool:
    """Puts a + before the key that Hydra does not find, so that the command itself refuses it, with the keys that it
    knows; and so that experiment=… is as good as +experiment=…. False where Hydra complains of something else."""
    unknown = re.match(r"Could not override '([^']+)'", message)
    for place, argument in enumerate(arguments):
        if place and unknown is not None and argument.startswith(f"{unknown[1]}="):
            arguments[place] = f"+{argument}"
            return True
    return False


def _quoted(arguments: list[str]) -> bool:
    """Puts quotes around values that Hydra's grammar refuses as they are: names with ü, &, # or (1) in them, say, and
    ~/, which is the home folder. False where that is no help."""
    changed = False
    for place, argument in enumerate(arguments):
        key, _, value = argument.partition("=")
        if place and value and not argument.startswith("-") and not _understood(value):
            quoted = _in_quotes(value)
            changed |= quoted != value
            arguments[place] = f"{key}={quoted}"
    return changed


def _in_quotes(value: str) -> str:
    """A value that is not understood, or such values of a flat list, in quotes; unchanged where they are no help."""
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


def _require_options(arguments: list[str]) -> None:
    """Refuses options that Hydra would answer with pages, and words that are no key=value."""
    for before, argument in itertools.pairwise(arguments):
        name, _, value = argument.partition("=")
        if name.startswith("-") and name not in _HYDRA_OPTIONS:
            key = name.strip("-") or "KEY"
            raise ConfigError(f"{argument} is not an option; settings are given as {key}={value or 'VALUE'}")
        if "=" not in argument and not argument.startswith(("-", "~")) and before not in _HYDRA_OPTIONS:
            raise ConfigError(f"settings are given as KEY=VALUE, got {argument!r}; --help shows the keys")


def _with_json_as_override(arguments: list[str]) -> list[str]:
    """`--json FILE` and `--json=FILE`, which the reports take as other tools do, are the override json=FILE."""
    result: list[str] = []
    waiting = iter(arguments)
    for argument in waiting:
        if argument == "--json":
            file = next(waiting, None)
            require(file is not None, "--json", "followed by a file name", file, "as in --json bench.json")
            result.append(f"json={file}")
        else:
            result.append(argument.removeprefix("--") if argument.startswith("--json=") else argument)
    return result


def _with(ours: tuple[str, ...], arguments: list[str]) -> list[str]:
    # before the person's own overrides, so that theirs win, and beside them, because argparse takes overrides in one
    # run only
    for place, argument in enumerate(arguments):
        if place and "=" in argument and not argument.startswith("-") and not arguments[place - 1].startswith("--conf"):
            return [*arguments[:place], *ours, *arguments[place:]]
    return [*arguments, *ours]


def _help() -> tuple[str, ...]:
    """What --help says before the keys: the command's own description, which is its module's."""
    text = _described().replace("\\", "\\\\").replace("'", "\\'")
    return f"hydra.help.app_name='python -m {_module()}'", f"hydra.help.header='{text}'"


def _described() -> str:
    return (sys.modules["__main__"].__doc__ or _module()).strip()


def _module() -> str:
    spec = sys.modules["__main__"].__spec__
    return spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).name


def _one_line(text: str) -> str:
    return " ".join(text.split("Config search path:")[0].split())


def _fail(message: str, code: int) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr, flush=True)
    return code
