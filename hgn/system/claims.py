"""Compares the content that a file claims with the file's size, before memory is allocated for it."""

import math
import pickletools
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hgn.schema import ConfigError

SMALL_BYTES = 64 << 20  # bytes that any file may claim
EXPANSION = 100  # bytes that a byte of a larger file may claim: arrays of zeros compress well
ITEM_BYTES = 400  # bytes that an operation of a pickle counts as, because each takes time, and so does an item
MOST_ITEMS = 10_000_000  # largest number of items of nested lists, with references resolved


def most_bytes(file_bytes: int) -> int:
    """Returns the bytes that the content of a file of this size may claim."""
    return max(SMALL_BYTES, EXPANSION * file_bytes)


class Claims:
    """Adds up the bytes that the content of a file claims. Each reading of a file needs one object."""

    def __init__(self, file: Path | str, file_bytes: int | None = None) -> None:
        self._file = file
        self._file_bytes = Path(file).stat().st_size if file_bytes is None else file_bytes
        self.most, self.used = most_bytes(self._file_bytes), 0

    def add(self, name: object, *counts: int) -> None:
        """Adds the product of `counts`. The last count is the size of an item.

        Raises ConfigError with the file and `name` when the sum exceeds the possible content of the file.
        """
        self.used += math.prod(map(int, counts)) if min(counts, default=0) >= 0 else self.most + 1
        if self.used > self.most:
            raise ConfigError(
                f"{self._file}: {name} must keep the content within {self.most} bytes, because the file has "
                f"{self._file_bytes}, got {' x '.join(map(str, counts))[:200]} more; write or fetch the file again"
            )


def require_plain_pickle(data: bytes, claims: Claims, names: re.Pattern[str] = re.compile(".*")) -> None:
    """Checks the sizes in a pickle, for which Python allocates memory at once, its calls (`module name`), and its keys.

    Adds to `claims` its operations, and its references with all items and texts of what they refer to.
    Raises ValueError or LookupError for a pickle that is cut, has a memo larger than itself, calls other names than
    `names`, or contains a copy, a set, a key of several items, or an integer of more than 64 bits: many keys could have
    one hash, and each would be compared with all others.
    """
    # a list for each object, shared by its references, with the bytes that it counts as, negative without items; None:
    # a mark; 0: the class OrderedDict
    stack: list[list[int] | None] = []
    memo: dict[int, list[int] | None] = {}
    total = 0
    for operation, argument, _ in pickletools.genops(data):
        name, text = operation.name, argument if isinstance(argument, (bytes, bytearray, str)) else b""
        total += ITEM_BYTES
        if total > claims.most - claims.used:
            claims.add("its pickle", total)
        if "PUT" in name and int(argument or 0) > len(data):
            raise ValueError(f"a memo of {argument} objects in a pickle of {len(data)} bytes")
        if isinstance(argument, int) and argument.bit_length() > 64:
            raise ValueError(f"an integer of {argument.bit_length()} bits")
        if name in ("GLOBAL", "STACK_GLOBAL", "INST") and names.fullmatch(str(argument)) is None:
            raise ValueError(f"{argument}, which is not a part of it")
        if "GET" in name:
            stack.append(memo[int(argument or 0)])
            total += abs((stack[-1] or [0])[0])
        elif "PUT" in name or name == "MEMOIZE":
            memo[int(argument) if argument is not None else len(memo)] = stack[-1]
        elif name == "GLOBAL" and argument == "collections OrderedDict":
            stack.append([0])
        else:
            before, items = operation.stack_before, list[list[int] | None]()  # from the top of the stack
            if pickletools.markobject in before:
                items, before = list(iter(stack.pop, None)), before[:-2]
            items += [stack.pop() for _ in before]
            sizes = [(item or [0])[0] for item in items]
            pairs = name == "REDUCE" and sizes[1] == 0 and sizes[0] > 0
            key = name in ("SETITEM", "SETITEMS", "DICT") and max(sizes[1::2], default=0) > 0
            if pairs or key or name in ("ADDITEMS", "FROZENSET", "DUP"):
                raise ValueError("a key of several items, a set, or a copy")
            size = sum(map(abs, sizes)) + ITEM_BYTES + len(text)
            if name in ("APPEND", "APPENDS", "SETITEM", "SETITEMS", "BUILD") and items[-1]:
                items[-1][0] = size
                stack.append(items[-1])
            else:
                own = [size if items else -size]
                stack += [None if kind is pickletools.markobject else own for kind in operation.stack_after]
    claims.add("its pickle", total)


def require_few_items(value: Any) -> None:
    """Checks the number of items of nested lists. Raises ValueError for more than MOST_ITEMS, references resolved."""
    if count_items(value) > MOST_ITEMS:
        raise ValueError(_too_many())


def _too_many() -> str:
    return f"more than {MOST_ITEMS} items; a reference counts as all of its items"


def _parts(value: Any) -> Iterable[Any] | None:
    return value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else None


def count_items(
    value: Any, parts: Callable[[Any], Iterable[Any] | None] = _parts, counts: dict[int, float] | None = None
) -> float:
    """Returns the number of values in `value`, references resolved, or infinity if it contains itself."""
    counts = {} if counts is None else counts
    if (inner := parts(value)) is None:
        return 1
    if id(value) not in counts:
        counts[id(value)] = math.inf
        counts[id(value)] = 1 + sum(count_items(part, parts, counts) for part in inner)
    return counts[id(value)]
