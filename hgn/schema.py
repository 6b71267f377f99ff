"""Strict conversion of plain mappings (YAML, JSON) to dataclasses.

Every file from a user (configs, scene files) or of another version (manifests, weights) passes through `from_mapping`.
Unknown keys, wrong types and missing fields raise a `ConfigError` that names field, rule, value and remedy.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import json
import linecache
import math
import re
import reprlib
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import unquote

from hgn.renamed import current_names, removed_remedy
from hgn.system.files import is_replaceable

T = TypeVar("T")
# control characters of terminals, text direction and lines; surrogates, except those for bytes of file names
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udc7f\udd00-\udfff]"
)
# Passwords may have spaces, slashes and @. They end at the last @ before a space. Digits before a space are a port,
# unless a single word with @ follows. Digits before a slash are a port, and the rest is a path.
_MOST = "{1,2000}"
_PORT, _WORD = r"\d+(?:[,;)'\"]|\s(?![^\s@:]+@)|$)", rf"(?:(?!://)\S){_MOST}"
_HOST = r"(?:[^\s/:@]{1,255}:\d{1,5}|\[?[\da-fA-F:.]{2,39}\](?::\d{1,5})?)/"
_USER = rf"[^\s/:@]{_MOST}:{_WORD}|[^/\s?#]{_MOST}|[^/:@'\"]{_MOST}:(?=\S)(?!{_PORT})(?:(?!://)[^@]){_MOST}"
_SECRET = r"(?:sig|token|secret|pass|pwd|cred|auth|jwt|sas|hmac|bearer|session|ticket)[\w.-]*|key(?:_?id)?|code"
_SECRET += r"|(?<![a-z])(?:pw|otp|sid|hash|st|[kp])"


def _without_value(query: re.Match[str]) -> str:
    """Returns a key and value of a URL, without the value if the key, which may be percent-encoded, names a secret."""
    secret = re.search(rf"(?i)(?:{_SECRET})[\[\]]*$", unquote(query[2]))
    return f"{query[1]}{query[2]}=…" if secret else query[0]


# keys outside URLs, with the sign that follows, and their values: a text, a list, or a word after its scheme
_KEY = r"[\w.-]{0,99}?(?:token|secret|passw(?:or)?d|authorization|api[_-]?key)\w*"
_VALUE = r"b?(?:'[^']*'?|\"[^\"]*\"?)|[\[({][^\])}\n]*[\])}]?|(?:(?:bearer|basic)\s+)?[^\s'\"]*[^\s'\",;.)\]}]"
_TOKEN = r"(?:hf|gh[oprsu]|npm)_(?=[^\W_]{16})|(?:AIza|github_pat_|(?:glpat|sk|xox[a-z]|pypi)-)(?=[\w-]*\d)"
_SECRETS = (  # pattern and replacement: for users of URLs and of addresses without a scheme, and for signatures
    (rf"(\w://)(?!{_HOST})(?:{_USER})?@", r"\1"),
    (
        rf"((?:^|['\"=])(?![\w+]+://|{_HOST}))[^\s'\"/:@]{_MOST}:(?![\s/])[^'\"@]{_MOST}@(?:(?:(?!://)[^\s'\"]){_MOST}@)?(?=[\w\[])",
        r"\1",
    ),
    # short, because any word may start it
    (
        rf"(?<![\w@.])(?!{_HOST})(?:[\w.+-]{{1,300}}@(?!{_HOST}))?[\w.+-]{{1,300}}:(?!/)(?:(?!://)\S){{1,300}}@(?=[\w\[])",
        "",
    ),
    (r"([?&;#])([\w.%\[\]-]{1,300})=[^&\s'\"#;]*", _without_value),
    (rf"(?i)(['\"])(\+{{0,2}}(?:[\w.]+=)?{_KEY}[ \t]*[=:][ \t]*)(?!['\"])(?:'\"'\"'|(?!\1).)+", r"\1\2…"),
    (rf"(?i)(?<![\w.?&;#%-])({_KEY}['\"]?[ \t]*[=:][ \t]*)(?:{_VALUE})", r"\1…"),
    (r"(?i)(\bbearer\s+)(?=\S*\d)[^\s'\"]+", r"\1…"),
    (rf"(?<![\w-])({_TOKEN})[\w-]{{16,}}", r"\1…"),
)
_LONG = 20_000  # characters of a message that is shortened before passwords are removed
# the owner's path, and the value's own name or index; joined for messages
_Path = str | tuple[Any, str | int]


@dataclasses.dataclass(frozen=True)
class Bound:
    """A rule for a value: a text, and a predicate that is false for NaN (see `require_bounds`)."""

    rule: str
    holds: Callable[[Any], bool]


def one_of(*choices: str) -> Bound:
    """Returns the rule that a value is among choices."""
    return Bound(f"one of {', '.join(choices)}", choices.__contains__)


N = TypeVar("N", int, float)
# fp32, in which scenes are simulated, would turn other numbers into 0 or infinity
Positive = Annotated[
    N,
    Bound("a finite number > 0", lambda value: 0 < value < math.inf),
    Bound("from 1e-30 to 1e30, the range of fp32", lambda value: 1e-30 <= value <= 1e30),
]
NonNegative = Annotated[
    N,
    Bound("a finite number >= 0", lambda value: 0 <= value < math.inf),
    Bound("at most 1e30, the range of fp32", lambda value: value <= 1e30),
]
# fp32 stores the squares of these numbers
Finite = Annotated[
    float, Bound("finite", math.isfinite), Bound("at most 1e15 in size", lambda value: abs(value) <= 1e15)
]
Vector = tuple[Finite, Finite, Finite]
Range = Annotated[
    tuple[float, float],
    Bound("from -1e15 to 1e15, the smaller one first", lambda ends: -1e15 <= ends[0] <= ends[1] <= 1e15),
]
Fraction = Annotated[N, Bound("from 0 to 1", lambda value: 0 <= value <= 1)]
AtMostOne = Annotated[N, Bound("at most 1", lambda value: value <= 1)]
BelowOne = Annotated[N, Bound("0 or more and below 1", lambda value: 0 <= value < 1)]
AtLeastOne = Annotated[N, Bound("at least 1", lambda value: value >= 1)]
OneOrMore = AtLeastOne[int]
Port = Annotated[int, Bound("0 to 65535", lambda value: 0 <= value < 65536)]
FolderName = Annotated[str, Bound("a folder name", bool)]
_REPLACEABLE = Bound("a new file, or one that HGN wrote", lambda name: is_replaceable(Path(name)))
FileName = Annotated[str, Bound("a file name", lambda name: Path(name).name != ""), _REPLACEABLE]  # an output file
PATH_RULE = "a path of at most 4,095 bytes, 255 in each name"  # limits of file systems


def triple(values: Iterable[float]) -> Vector:
    """Returns three numbers of any kind as plain ones."""
    x, y, z = map(float, values)
    return x, y, z


def is_path(text: str) -> bool:
    """Returns whether a text follows PATH_RULE. A URL may be longer."""
    data = text.encode(errors="surrogatepass")
    return "://" in text or (len(data) < 4096 and max(map(len, data.split(b"/"))) < 256)


PathName = Annotated[str, Bound(PATH_RULE, is_path)]
FrameCount = Annotated[
    int, Bound("at least 2", lambda value: value >= 2), Bound("at most 1,000,000", lambda value: value <= 1_000_000)
]
LayerSize = Annotated[Positive[int], Bound("at most 65,536", lambda value: value <= 65_536)]
OrdinarySize = Annotated[float, Bound("from 1e-9 to 1e9", lambda value: 1e-9 <= value <= 1e9)]
BoxSize = tuple[OrdinarySize, OrdinarySize, OrdinarySize]
FrameRate = Annotated[float, Bound("from 0.001 to 1e6", lambda value: 1e-3 <= value <= 1e6)]
FewLayers = Annotated[Positive[int], Bound("at most 1,000", lambda value: value <= 1_000)]


_shown = reprlib.Repr()  # a file's value may have millions of items, and with YAML's references 10^12
_shown.maxlevel, _shown.maxstring, _shown.maxlong, _shown.maxother = 4, 300, 60, 300
_shown.maxlist = _shown.maxtuple = _shown.maxdict = _shown.maxset = 12


class ConfigError(ValueError):
    """An invalid value. The message names field, rule, value and remedy; it is `printable`, and shortened if long."""

    def __init__(self, message: str) -> None:
        if len(message) > _LONG:  # the patterns take seconds for a megabyte
            # the last part begins after a space, so that it does not begin within a password
            message = f"{message[: _LONG // 2]} … {message[-_LONG // 2 :].partition(' ')[2]}"
        message = printable(message)
        super().__init__(message if len(message) <= 1400 else f"{message[:1000]} … {message[-350:]}")


def printable(text: str) -> str:
    """Returns a text for terminals and pages, without users and signatures of URLs, secrets, and control characters."""
    text = re.sub(r"[^\S\t-\r ]", lambda space: repr(space[0])[1:-1], text)  # these do not end a password
    for pattern, kept in _SECRETS:
        text = re.sub(pattern, kept, text)
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def strict_json(text: str | bytes, **options: Any) -> Any:
    """Parses JSON, with options of json.loads. Raises: ValueError, also for a repeated key and for deep nesting."""
    try:
        return json.loads(text, object_pairs_hook=_without_repetition, **options)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        ((repeated, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key {repeated[:100]} is given twice")
    return mapping


def from_mapping(cls: type[T], mapping: object, path: _Path = "") -> T:
    """Builds dataclass `cls` from `mapping`, recursively.

    Integers become floats and lists become tuples, nothing else. `path` prefixes names in errors. Raises: ConfigError.
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(
            f"{_text(path) or cls.__name__} must be a mapping of keys to values, got {_shown.repr(mapping)}"
        )
    hints, fields = _fields(cls)  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in mapping.items():
        if key not in fields:
            name = _text((path, str(key)))
            remedy = removed_remedy(section_of(cls), str(key), value)
            if value is None and isinstance(key, (int, float)):
                remedy = "a list needs brackets, as in [0.1, 0.2, 0.3]"
            remedy = remedy or known_keys(str(key), fields)
            raise ConfigError(f"{name} is not a known key; {remedy}")
        values[key] = _convert(hints[key], value, (path, key))
    for name, needed in fields.items():
        if needed and name not in values:
            raise ConfigError(f"{_text((path, name))} is missing; it must be given")
    try:
        return cls(**values)
    except ConfigError as error:
        if path:
            raise ConfigError(f"{_text(path)}.{error}") from None
        raise


@functools.cache
def _fields(cls: type) -> tuple[dict[str, Any], dict[str, bool]]:
    """Returns the types of a dataclass's fields, and whether each is required. It is slow, so results are cached."""
    given = {field.name: field for field in dataclasses.fields(cls) if field.init}
    missing = dataclasses.MISSING
    return typing.get_type_hints(cls), {k: f.default is f.default_factory is missing for k, f in given.items()}


def section_of(cls: type) -> str:
    """Returns the section of the configuration for a dataclass, e.g. error_vs_time for ErrorVsTimeConfig."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__.removesuffix("Config")).lower()


@functools.cache
def _shape(hint: Any) -> tuple[Any, tuple[Any, ...], bool]:
    """Returns origin and arguments of a type, and whether it is a dataclass."""
    return typing.get_origin(hint), typing.get_args(hint), dataclasses.is_dataclass(hint)


def from_stored(cls: type[T], mapping: object, section: str) -> T:
    """Builds a dataclass from a section of a stored file, possibly of an earlier release."""
    return from_mapping(cls, current_names(mapping, section) if isinstance(mapping, Mapping) else mapping, section)


def known_keys(key: str, names: Iterable[str], what: str = "known keys") -> str:
    """Returns the remedy for an unknown key: a similar key, or else all keys. `what` is their name in the message."""
    names = list(names)
    return near_name(key, names) or f"{what}: {', '.join(names)}"


def near_name(name: str, names: Iterable[str], cutoff: float = 0.6) -> str:
    """Returns `did you mean NAME?` for a similar name, or an empty text."""
    return "".join(f"did you mean {close}?" for close in difflib.get_close_matches(name, names, 1, cutoff))


def near_file(path: Path) -> str:
    """Returns `did you mean NAME?` for a file of similar name and ending in the folder of `path`, or an empty text."""
    names = {each.name for each in path.parent.glob("*") if near_name(each.suffix, [path.suffix])}
    return near_name(path.name, names - {path.name}, 0.8)


def to_mapping(value: Any) -> Any:
    """Converts to plain dicts, lists and scalars for JSON or YAML. Inverts `from_mapping`."""
    if type(value) in (int, float, str, bool):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_mapping(getattr(value, field.name)) for field in dataclasses.fields(value) if field.init}
    if isinstance(value, Mapping):
        return {key: to_mapping(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_mapping(item) for item in value]
    return value


def default_mapping(cls: type) -> dict[str, Any]:
    """Returns a dataclass's defaults as plain containers, inherited ones last, with Hydra's `???` for required ones."""
    result: dict[str, Any] = {}
    for field in sorted(dataclasses.fields(cls), key=lambda field: field.name not in cls.__annotations__):
        if field.default is not dataclasses.MISSING:
            result[field.name] = to_mapping(field.default)
        elif field.default_factory is not dataclasses.MISSING:
            result[field.name] = to_mapping(field.default_factory())
        else:
            result[field.name] = "???"
    return result


def field_comments(cls: type) -> dict[str, str]:
    """Returns the comment of each field of a dataclass: the lines above it, and the comment on its line."""
    comments: dict[str, str] = {}
    for base in filter(dataclasses.is_dataclass, cls.__bases__):
        comments |= field_comments(base)
    source = "".join(linecache.getlines(inspect.getfile(cls)))  # inspect.getsource parses the file: 15 ms a class
    body = re.search(rf"^class {cls.__name__}\b.*((?:\n(?: .*)?)+)", source, re.MULTILINE)
    above: list[str] = []
    for line in body[1].splitlines() if body else ():
        text = line.strip()
        if text.startswith("def "):
            break
        field = re.match(r"(\w+): [^#]*(?:# (.*))?$", text)
        if field and not text.startswith("#"):
            comments[field[1]] = "; ".join(part for part in (" ".join(above), field[2]) if part)
        above = [*above, text.lstrip("# ")] if text.startswith("#") else []
    return comments


def require(rule_holds: bool, field: str, rule: str, value: object, remedy: str = "") -> None:
    """Raises ConfigError `<field> must be <rule>, got <value>; <remedy>` unless the rule holds."""
    if not rule_holds:
        choices = rule.removeprefix("one of ").split(", ") if rule.startswith("one of ") else ()
        remedy = remedy or near_name(str(value), choices)
        value = str(value) if isinstance(value, Path) else value
        raise ConfigError(f"{field} must be {rule}, got {_shown.repr(value)}" + (f"; {remedy}" if remedy else ""))


def no_file(field: str, path: Path, remedy: str) -> ConfigError:
    """Returns the error of a path that is no file."""
    return ConfigError(f"{field} must be an existing file, got {path}{', a folder' * path.is_dir()}; {remedy}")


def require_count(field: str, value: object, least: int) -> None:
    """Raises ConfigError unless an argument is a whole number of at least `least`."""
    whole = isinstance(value, Integral) and not isinstance(value, bool) and value < 2**63
    require(whole, field, "a whole number", value)
    require(value >= least, field, f"at least {least}", value)  # type: ignore[operator]


def require_vector(field: str, value: Any, least: float = -1e15, most: float = 1e15) -> None:
    """Raises ConfigError unless an argument is three numbers from `least` to `most`."""
    items = [*value] if isinstance(value, (tuple, list)) or getattr(value, "shape", None) == (3,) else []
    fits = len(items) == 3 and all(isinstance(x, Real) and least <= x <= most for x in items)  # type: ignore[operator]
    require(fits, field, f"three numbers from {least:g} to {most:g}", value)


def require_replaceable(field: str, *files: Path) -> None:
    """Raises ConfigError for a file that another program wrote."""
    for file in files:
        require(_REPLACEABLE.holds(file), field, _REPLACEABLE.rule, str(file), "choose another name, or move that file")


def require_bounds(owner: object) -> None:
    """Checks the fields of a dataclass, and the items of its tuples, against the `Bound`s of their annotations."""
    cls: Any = type(owner)
    for name, bounds in _bounds_of_fields(cls).items():
        _require_bound(bounds, getattr(owner, name), name)


class Bounded:
    """A dataclass whose fields are checked by `require_bounds`, and by nothing else."""

    def __post_init__(self) -> None:
        require_bounds(self)


@functools.cache
def _bounds_of_fields(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {name: bounds for name, hint in hints.items() if (bounds := _bounds_of(hint))}


def _bounds_of(hint: Any) -> tuple[tuple[Bound, ...], Any, Any] | None:
    """Returns the bounds of a type, its origin, and the same of its items or its option; None without bounds."""
    own, item = getattr(hint, "__metadata__", ()), next(filter(None, map(_bounds_of, typing.get_args(hint))), None)
    return (own, typing.get_origin(hint), item) if own or item else None


def _require_bound(bounds: Any, value: Any, name: str) -> None:
    own, origin, item = bounds
    for bound in own:
        require(bound.holds(value), name, bound.rule, value)
    if item and origin in (tuple, dict):
        for key, each in value.items() if origin is dict else enumerate(value):
            _require_bound(item, each, f"{name}.{key}" if origin is dict else f"{name}[{key}]")
    elif item and value is not None:  # an optional type
        _require_bound(item, value, name)


def _text(path: _Path) -> str:
    if isinstance(path, str):
        return path
    owner, name = _text(path[0]), path[1]
    if isinstance(name, int):
        return f"{owner}[{name}]"
    return f"{owner}.{name}" if owner else name


def _convert(hint: Any, value: Any, path: _Path) -> Any:
    if hint is type(value) and hint in (float, str, bool):
        if hint is str and _CONTROL.search(value):
            raise ConfigError(f"{_text(path)} must be text without control characters, got {_shown.repr(value)}")
        return value
    if type(value) is int and not -(2**63) <= value < 2**63:
        raise ConfigError(f"{_text(path)} must be a number of at most 63 bits, got {value.bit_length()} bits")
    origin, arguments, is_dataclass = _shape(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        options = [option for option in arguments if option is not type(None)]
        if isinstance(value, (list, tuple)):
            options = [option for option in options if _shape(option)[0] is tuple] or options
        if len(options) == 1:
            return _convert(options[0], value, path)
        for option in options:
            try:
                return _convert(option, value, path)
            except ConfigError:
                continue
        raise ConfigError(f"{_text(path)} must be {_name(hint)}, got {_shown.repr(value)}{_unquoted(hint, value)}")
    if is_dataclass:
        return from_mapping(hint, value, path)
    if origin is tuple:
        more = len(arguments) == 2 and arguments[1] is Ellipsis
        if not isinstance(value, (list, tuple)):
            count = "" if more else f" of {len(arguments)} values"
            raise ConfigError(f"{_text(path)} must be a list{count}, got {_shown.repr(value)}; write it in brackets")
        if more:
            return tuple([_convert(arguments[0], item, (path, i)) for i, item in enumerate(value)])
        if len(value) != len(arguments):
            raise ConfigError(
                f"{_text(path)} must be a list of {len(arguments)} values, got {len(value)}: {_shown.repr(value)}"
            )
        pairs = zip(arguments, value, strict=True)
        return tuple([_convert(item_hint, item, (path, i)) for i, (item_hint, item) in enumerate(pairs)])
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{_text(path)} must be a mapping, got {_shown.repr(value)}")
        return {
            _convert(arguments[0], key, path): _convert(arguments[1], item, (path, str(key)))
            for key, item in value.items()
        }
    if hint is Any:
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if hint in (bool, int, str) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool):
        return value
    seen = f"{_shown.repr(value)} ({type(value).__name__})"
    raise ConfigError(f"{_text(path)} must be {_name(hint)}, got {seen}{_unquoted(hint, value)}")


def _name(hint: Any) -> str:
    """Returns the words for a type in messages."""
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "text", type(None): "null"}
    origin, arguments, _ = _shape(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_name, arguments))
    return f"a list of {len(arguments)} values" if origin is tuple else names.get(hint, str(hint))


def _unquoted(hint: Any, value: Any) -> str:
    """Returns the remedy for a number in quotes or with a decimal comma, or an empty text."""
    number = re.fullmatch(r"[-+]?[\d.]*(,?)[\d.]+([eE][-+]?\d+)?", value if isinstance(value, str) else "")
    return f"; write it with{' a decimal point' if number[1] else 'out quotes'}" if number and hint is not bool else ""
