"""Prints `--help`: a command's description, and every key with its value and comment."""

import dataclasses
import re
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from hgn.hydra_compat import dataclass_of
from hgn.schema import field_comments


def help_lines(mapping: Mapping[str, Any], folder: Path, config_name: str) -> Iterator[str]:
    """Yields a command's composed configuration as YAML with comments. The command's file lies in `folder`."""
    file = folder / f"{config_name}.yaml"
    cls = dataclass_of(file)
    comments = field_comments(cls) if cls else {}
    comments |= re.findall(r"^(\w+):[^#\n]*# (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
    for key, value in mapping.items():
        files = sorted((folder / key).glob("*.yaml"))
        if files:
            comments[key] = f"{key}=" + " or ".join(each.stem for each in files)
        section = next(filter(None, map(dataclass_of, files)), None) or _nested(cls, key)
        if isinstance(value, Mapping) and section is not None:
            yield _line(key, None, comments.get(key))
            inner = field_comments(section)
            yield from (f"  {_line(name, item, inner.get(name))}" for name, item in value.items())
        else:
            yield _line(key, value, comments.get(key))
    experiments = sorted((folder / "experiment").glob("*.yaml"))
    if experiments:
        yield f"# +experiment={' or '.join(each.stem for each in experiments)}"


def _nested(cls: type | None, key: str) -> type | None:
    """Returns the type of a field that contains a dataclass, or None."""
    hint = typing.get_type_hints(cls).get(key) if cls else None
    return hint if isinstance(hint, type) and dataclasses.is_dataclass(hint) else None


def _line(key: str, value: Any, comment: str | None) -> str:
    shown = (
        yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=1000, sort_keys=False)
        .removesuffix("...\n")
        .strip()
    )
    text = f"{key}:" if value is None and comment is None else f"{key}: {shown}"
    return f"{text} # {comment}" if comment else text
