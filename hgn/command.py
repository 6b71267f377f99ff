"""Runs all commands: Hydra composes the config, and errors that a user can fix end in one line.

Exit codes: 0 success, 1 machine error (full disk, no permission), 2 invalid input (also a file, pipe or device in
place of a folder, or the reverse), 130 Ctrl-C, 143 SIGTERM, 129 SIGHUP, 141 closed output pipe (as in `… | head`).
"""

import atexit
import errno
import gc
import importlib
import io
import itertools
import os
import re
import select
import stat
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, cast

from hgn.config import config_directory
from hgn.schema import PATH_RULE, ConfigError, is_path, printable, require
from hgn.system.extras import missing_extra
from hgn.system.machine import memory_is_full
from hgn.system.signals import Signals, interrupt, signals_delayed

EXIT_MACHINE, EXIT_INPUT, EXIT_INTERRUPTED, EXIT_UNREAD = 1, 2, 130, 141

_MACHINE_ERRORS = {
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space",
    errno.EACCES: "check the permissions",
    errno.EPERM: "check the permissions",
    errno.EROFS: "choose a folder that can be written to",
    errno.ENOENT: "check its folder or link",
    errno.ETIMEDOUT: "check its server or disk",
    errno.ECONNABORTED: "free memory if the system ended them,",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "close other programs",
    errno.ENOMEM: "close other programs, use smaller input or another machine",
    errno.ECHILD: "free some memory, or check the device,",
}

# A given path leads through a file, or names an object of another kind.
_WRONG_PATHS = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)
ROLLOUT_ENDINGS = (".vtkhdf", ".hdf", ".hdf5", ".h5")
SHOW_KEYS = "--help shows the keys"
Main = Callable[[dict[str, Any]], int | None]


def run_command(main: Main | str, config_name: str) -> NoReturn:
    """Composes `conf/<config_name>.yaml` with the command line, calls `main` with the plain mapping, and exits.

    `main` may be the name of the module that contains it, which is then loaded after the configuration. The file of a
    command without config groups is in `conf/command/`. Elsewhere Hydra would take the command's keys
    (`scene=my_scene.yaml`) for choices of a group.

    Hydra's options (--cfg, --config-path, --config-name, --multirun) work. --help prints keys, values and comments.
    `main` returns an exit code, or None for 0. Errors that a user can fix are printed as one line, `error: ...`.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # the process was started without this stream
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 - open as long as the process runs
        elif isinstance(stream := getattr(sys, name), io.TextIOWrapper) and (
            stream.errors == "strict" or stream.encoding.lower() != "utf-8"
        ):
            stream.reconfigure(errors="replace")  # for latin-1, ASCII, and paths that are not UTF-8
    if isinstance(stream := sys.stderr, io.TextIOWrapper) and stream is sys.__stderr__:
        messages = io.BufferedWriter(_Messages(stream.fileno(), "wb", closefd=False))
        sys.stderr = io.TextIOWrapper(messages, stream.encoding, stream.errors, line_buffering=True)
    atexit.register(gc.freeze)  # otherwise the process searches all modules for garbage before it ends, in 0.4 s
    code: int | str | None
    try:
        try:
            with Signals(interrupt) as signals:
                code = _exit_code(main, config_name)
            if code == EXIT_INTERRUPTED:  # perhaps a library raised another KeyboardInterrupt, without the number
                code = signals.exit_code or code
        except SystemExit as end:  # Hydra ends the process after --help
            code = end.code
        sys.stdout.flush()
    except OSError as error:
        full = error.errno == errno.ENOSPC
        if not full and not _unread():
            raise
        code = _fail("no space left on the device of the standard output", EXIT_MACHINE) if full else EXIT_UNREAD
        for stream in (sys.stdout, sys.stderr):  # the buffers cannot be flushed at exit
            with Path(os.devnull).open("wb") as nowhere:
                os.dup2(nowhere.fileno(), stream.fileno())
    sys.exit(code)


class _Messages(io.FileIO):
    """Writes standard error. Messages that a full disk or a closed terminal refuses are lost without an error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data) or 0
        except BrokenPipeError:  # no reader: see `_unread`
            raise
        except OSError:
            return len(data)


def _exit_code(main: Main | str, config_name: str) -> int:
    mapping: dict[str, Any] = {}
    try:
        code = 0
        if {"--help", "-h"} & set(sys.argv[1:]):
            _print_help(config_name)
            return 0
        for mapping in _compose(config_name):
            if isinstance(main, str):
                main = cast("Main", importlib.import_module(main).main)
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
        if _is_own_fault(error):
            raise
        reason, wrong = error.strerror or str(error), error.errno in _WRONG_PATHS
        remedy = _MACHINE_ERRORS.get(error.errno or 0, "check the disk and its network")
        place = f": {error.filename}" if error.filename else ""
        text = f"{reason}{place}; {'choose another path' if wrong else remedy} and run the same command again"
        if wrong and error.filename and (setting := _setting_of(str(error.filename), mapping)):
            text = f"{setting[0]} must be another path, got {setting[1]!r}: {reason}"
        code = EXIT_INPUT if wrong or _is_special(error.filename) else EXIT_MACHINE
        code = _fail(str(ConfigError(text)), code)  # ConfigError shortens the text
    except (MemoryError, RuntimeError, ImportError) as error:
        if not memory_is_full(error):
            raise
        code = _fail(f"memory is full ({error}); use smaller input or another machine", EXIT_MACHINE)
    except KeyboardInterrupt as interruption:  # by Ctrl-C, or with the number of another signal
        code = _fail("interrupted", 128 + interruption.args[0] if interruption.args else EXIT_INTERRUPTED)
    return code


def _is_own_fault(error: OSError) -> bool:
    """Returns whether this program caused an error: a missing file, not a broken link, in an existing folder.

    Folders without blocks, such as /proc, take no new files.
    """
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        path = Path(os.fsdecode(error.filename))
        return path.parent.is_dir() and not path.is_symlink() and os.statvfs(path.parent).f_blocks > 0
    return isinstance(error, BrokenPipeError)


def _setting_of(path: str, mapping: Mapping[str, Any]) -> tuple[str, str] | None:
    """Returns key and value of the setting that names a path, or else the nearest folder above or below it."""
    here, nearest, found = str(Path(path).resolve()), 0, None
    for key, value in mapping.items():
        given = value
        if isinstance(value, Mapping) and (inner := _setting_of(path, value)):
            key, given = f"{key}.{inner[0]}", inner[1]
        if not isinstance(given, str) or not given:
            continue
        end = str(Path(given).resolve())
        common = os.path.commonpath([here, end])
        # any text is a path below the current folder, so only a setting that leads out of it is below a folder above
        through = common == here and (Path(given).is_absolute() or not Path.cwd().is_relative_to(here) or end == here)
        rank = len(common) + (through and end != here)
        if (through or common == end) and rank > nearest:
            nearest, found = rank, (key, given)
    return found


def _is_special(name: object) -> bool:
    """Returns whether a path is, or leads through, a pipe, a device or a socket."""
    for path in (Path(str(name)), *Path(str(name)).parents):
        with suppress(OSError):
            kind = stat.S_IFMT(path.stat().st_mode)
            if kind not in (stat.S_IFREG, stat.S_IFDIR):
                return True
    return False


def _unread() -> bool:
    """Returns whether standard output or standard error is a pipe without a reader."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        with suppress(io.UnsupportedOperation):  # a stream in memory
            poll.register(stream.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


@signals_delayed()  # Hydra and OmegaConf report interruptions as errors of settings
def _compose(config_name: str, complete: bool = True) -> list[dict[str, Any]]:
    """Returns the configurations of the command line. With `complete=False` required keys may be missing."""
    from hgn.hydra_compat import compose

    arguments, folder = sys.argv, _folder(config_name)
    _require_options(arguments, lambda: compose(folder, config_name, arguments[:1], complete=False)[0])
    return compose(folder, config_name, [a for a in arguments if a not in ("--help", "-h")], complete)


def _folder(config_name: str) -> Path:
    folder = config_directory()
    return folder / "command" if (folder / "command" / f"{config_name}.yaml").is_file() else folder


def _print_help(config_name: str) -> None:
    from hgn.command_help import help_lines

    (mapping,) = _compose(config_name, complete=False)
    print((sys.modules["__main__"].__doc__ or config_name).strip(), "", sep="\n")
    print(*help_lines(mapping, _folder(config_name), config_name), sep="\n")


def _require_options(arguments: list[str], settings: Callable[[], dict[str, Any]]) -> None:
    """Refuses options after which Hydra would print pages, words without `=`, deletions, and paths that are too long.

    `settings` returns the default configuration of the command.

    A deleted key would have the default of its dataclass, which differs from that of conf/, or be missing.
    """
    from hgn.hydra_compat import OPTIONS

    for before, argument in itertools.pairwise(arguments):
        name, _, value = argument.partition("=")
        if name.startswith("-") and name not in OPTIONS:
            key = name.strip("-")
            example = f"{key}={value or 'VALUE'}" if key.partition(".")[0] in settings() else f"KEY=VALUE; {SHOW_KEYS}"
            raise ConfigError(f"{argument} is not an option; settings are given as {example}")
        if argument.startswith("~") and before not in OPTIONS:
            require(False, name[1:], "kept", argument, f"leave it out, or write {name[1:]}=VALUE")
        if "=" not in argument and not argument.startswith("-") and before not in OPTIONS:
            raise ConfigError(f"settings are given as KEY=VALUE, got {argument!r}; {SHOW_KEYS}")
        for item in re.split(r"[\[\]{},]", value if "://" not in value else ""):
            require(is_path(item), name.lstrip("+"), PATH_RULE, item, "choose a shorter one")


def _fail(message: str, code: int) -> int:
    print(f"error: {printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    return code


def require_rollout_name(field: str, name: str | None, *more: str) -> None:
    """Refuses names of folders, pictures and other formats for a rollout file.

    `more` are accepted suffixes in addition to ROLLOUT_ENDINGS.
    """
    *some, last = (*ROLLOUT_ENDINGS, *more)
    made = "pictures" if more else "pictures, USD and PLY"
    ends = name is None or Path(name).suffix in (*some, last)
    rule = f"a name that ends in {', '.join(some)} or {last}"
    require(ends, field, rule, name, f"tools.render makes {made} of a rollout file")
