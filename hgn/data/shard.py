"""Writes shards as tar files, with the same bytes for the same episode, and finds the offsets of their members."""

import tarfile
from collections.abc import Iterator
from pathlib import Path

from hgn.scene.episode import Episode, encode_episode
from hgn.schema import ConfigError
from hgn.system.files import errors_name, open_at_once


def episode_tar(episode: Episode) -> Iterator[bytes | memoryview]:
    """Yields the parts of an episode's tar. It has no times and owners, so its bytes depend on the episode only."""
    written = 0
    for name, parts in encode_episode(episode).items():
        info = tarfile.TarInfo(f"{episode.key}.{name}")
        info.size, info.mtime, info.mode = sum(map(len, parts)), 0, 0o644
        header, rest = info.tobuf(tarfile.GNU_FORMAT), bytes(-info.size % tarfile.BLOCKSIZE)
        written += len(header) + info.size + len(rest)
        yield from (header, *parts, rest)
    yield tar_end(written)


def tar_end(written: int) -> bytes:
    """Returns the end of a tar: two empty blocks, padded to a whole record."""
    end = 2 * tarfile.BLOCKSIZE
    return bytes(end + -(written + end) % tarfile.RECORDSIZE)


def locate_members(path: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Returns the place of each member's data in a tar: key -> name after `<key>.` -> (offset, bytes).

    It reads the plain headers of `episode_tar` only: tarfile takes hours for others of a few hundred kB.
    Raises: ConfigError if the file is not a complete tar of plain files with such headers.
    """
    located: dict[str, dict[str, tuple[int, int]]] = {}
    size, place = path.stat().st_size, 0
    try:
        with errors_name(path), open_at_once(path) as file:
            while any(block := file.read(tarfile.BLOCKSIZE)) or not place:
                info, start = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape"), place + tarfile.BLOCKSIZE
                if info.type != tarfile.REGTYPE or not 0 <= info.size <= size - start:
                    raise tarfile.ReadError(f"{info.name} of type {info.type!r} with {info.size} bytes")
                key, _, name = info.name.partition(".")
                if name in located.setdefault(key, {}):
                    raise tarfile.ReadError(f"{info.name} twice")
                located[key][name] = (start, info.size)
                place = file.seek(start + info.size + -info.size % tarfile.BLOCKSIZE)
    except tarfile.TarError as error:
        raise ConfigError(
            f"{path} must be a complete tar, got {error}; delete it and run the generator again"
        ) from None
    return located
