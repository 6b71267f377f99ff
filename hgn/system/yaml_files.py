"""Reads YAML and JSON files that people write. It is strict, because much of YAML 1.1 is unexpected.

In YAML 1.1 a repeated key would replace the first one, 010 would be eight, 1:30 ninety, and 1_0 ten. This module
refuses all of these and names the key and the line.
"""

import itertools
import re
from pathlib import Path
from typing import Any

import yaml

from hgn.schema import ConfigError, require, strict_json
from hgn.system.claims import count_items
from hgn.system.files import errors_name

MAXIMUM_BYTES = 250_000  # largest size of a YAML file: PyYAML takes a CPU second for 50 kB
MAXIMUM_NODES = 100_000  # values of a file, aliases resolved
MAXIMUM_DIGITS = 1000  # characters of a number of a file: Python does not print integers of 4,300 digits
# of PyYAML, of thousands of digits, of deep nesting, and of tags such as `!!bool 5`
_ERRORS = (yaml.YAMLError, ValueError, RecursionError, LookupError, TypeError, AttributeError, ArithmeticError)
_OCTAL = re.compile(r"[-+]?0[0-7_]*[1-7][0-7_]*")
_SEXAGESIMAL = re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?")


def read_yaml(path: Path) -> Any:
    """Returns the content of a YAML file as plain containers.

    Raises ConfigError, one line that starts with the path, for: a file that cannot be read, more than MAXIMUM_BYTES, a
    repeated key, numbers that are octal, sexagesimal, very long or have _, and more than MAXIMUM_NODES values, aliases
    resolved.
    """
    rule, size = f"a YAML file of at most {MAXIMUM_BYTES} bytes", path.stat().st_size
    require(size <= MAXIMUM_BYTES, str(path), rule, size, "particles belong in .npz files")
    try:
        with errors_name(path):
            text = path.read_text(encoding="utf-8")
        return yaml.load(text, _Loader)
    except UnicodeDecodeError as error:
        zipped = error.object.startswith(b"PK\x03\x04")
        reason = "a zip file; unpack it, and give the YAML file in it" if zipped else "not UTF-8 text"
        raise ConfigError(f"{path} must be a YAML file: it is {reason}") from error
    except _ERRORS as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        cause = str(getattr(error, "problem", None) or error).splitlines()
        remedy = "; check the indentation" if "<block end>" in cause[0] else ""
        raise ConfigError(f"{path} must be a YAML file: {place}{' '.join(cause)}{remedy}") from error


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file. Raises ValueError for another file, or for a repeated key."""
    with errors_name(path):
        return strict_json(path.read_text("utf-8"))


class _Loader(yaml.SafeLoader):
    """Reads 1e5 and -.5 as numbers, as YAML 1.2 does. PyYAML requires 1.0e+5 and -0.5."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if count_items(node, _parts) > MAXIMUM_NODES:
            raise ValueError(f"it has more than {MAXIMUM_NODES} values; an alias counts as all of its values")
        if node is not None:
            _check(node, "", set(), self)
        return node


def _parts(node: Any) -> Any:
    if isinstance(node, yaml.MappingNode):
        return itertools.chain.from_iterable(node.value)
    return node.value if isinstance(node, yaml.SequenceNode) else None


def _check(node: yaml.Node, name: str, visited: set[int], loader: _Loader) -> None:
    """Refuses keys repeated in any spelling, and numbers that YAML 1.1 reads in other bases. Raises ValueError."""
    if id(node) in visited:
        return
    visited.add(id(node))
    line = node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        lines: dict[Any, int] = {}
        for key, item in node.value:
            word, at = str(key.value), key.start_mark.line + 1
            _check(key, word, visited, loader)
            plain = isinstance(key, yaml.ScalarNode) and not key.tag.endswith(":merge")
            value = loader.construct_object(key) if plain else key.tag
            if first := lines.get(word, lines.get(value)):
                raise ValueError(f"line {at}: the key {word} is given twice, first in line {first}")
            lines[word] = lines[value] = at
            _check(item, word, visited, loader)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check(item, name, visited, loader)
    elif node.tag.endswith((":int", ":float")):
        if (count := len(node.value)) > MAXIMUM_DIGITS:
            rule = f"is a number of {count} characters; at most {MAXIMUM_DIGITS} are read"
            raise ValueError(f"line {line}: {name[:40]}: {node.value[:40]} {rule}")
        if _OCTAL.fullmatch(node.value):
            number = node.value.replace("_", "")[:4000]  # Python prints at most 4300 digits
            remedy = ", or ".join(dict.fromkeys(str(int(number, base))[:40] for base in (10, 8)))
            raise ValueError(f"line {line}: {name}: {node.value[:40]} is an octal number in YAML; write {remedy}")
        if _SEXAGESIMAL.fullmatch(node.value):
            remedy = "write it in decimals, or in quotes"
            raise ValueError(f"line {line}: {name}: {node.value[:40]} is a number of base 60 in YAML; {remedy}")
        if "_" in node.value:
            raise ValueError(f"line {line}: {name}: {node.value[:40]} is a number with _; write it without")


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?((\d+\.?\d*|\.\d+)[eE][-+]?\d+|\.\d+)$"), list("-+.0123456789")
)
