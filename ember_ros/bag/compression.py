"""Unpacks what a bag has compressed: chunks, messages and files, within limits. Pure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ember_ros.bag.guard import (
    MAX_BYTES,
    MAX_TIMES,
)
from ember_ros.bag.storage import needs_rosbags
from ember_ros.bounded_io import open_file
from ember_ros.errors import shown

ZSTD = b"\x28\xb5\x2f\xfd"
"""The first bytes of data that zstd has compressed."""


def _zstd() -> Any:
    try:
        import zstandard
    except ModuleNotFoundError as error:
        raise needs_rosbags(error) from error
    return zstandard


def _decompressor() -> Any:
    return _zstd().ZstdDecompressor(max_window_size=MAX_BYTES)


def unpack(data: bytes, compression: str, size: int, limit: int = MAX_BYTES) -> bytes:
    """Return uncompressed data, of which at most ``size`` bytes and one are ever in memory.

    Raises:
        ValueError: it has another size, is too large, or has another compression.
    """
    if size > limit:
        raise ValueError(f"{size} bytes in one chunk; up to {limit} are unpacked")
    if compression == "":
        unpacked_data = data
    elif compression == "zstd":
        with _decompressor().stream_reader(data) as reader:
            unpacked_data = reader.read(size + 1)
    elif compression == "lz4":
        import lz4.frame

        unpacked_data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    else:
        raise ValueError(f"compressed as {shown(compression)}; zstd or lz4 would be right")
    if len(unpacked_data) != size:
        raise ValueError(f"{len(unpacked_data)} bytes are unpacked instead of {size}")
    return bytes(unpacked_data)


def plain(data: bytes) -> bytes:
    """Return a message uncompressed: one that begins like zstd cannot be CDR, and is unpacked.

    Raises:
        ValueError: it is too large, or cut off.
    """
    if data[:4] != ZSTD:
        return data
    with _decompressor().stream_reader(data, read_across_frames=True) as reader:
        message = bytes(reader.read(MAX_BYTES + 1))
    if len(message) > MAX_BYTES:
        raise ValueError(f"a message of more than {MAX_BYTES} bytes when it is unpacked")
    size = _zstd().frame_content_size(data)
    if size >= 0 and size != len(message):
        raise ValueError(f"a message of {len(message)} bytes with a header that says {size}")
    return message


def unpacked(file: Path, folder: Path) -> Path:
    """Return a file that was compressed as a whole, unpacked into ``folder``; others unchanged.

    Raises:
        ValueError: it is too large when it is unpacked.
    """
    with open_file(file) as raw:
        if raw.read(4) != ZSTD:
            return file
        raw.seek(0)
        into, limit = folder / file.stem, MAX_BYTES + file.stat().st_size * MAX_TIMES
        size = _zstd().frame_content_size(raw.read(18))  # -1 if it is unknown
        raw.seek(0)
        if size > limit:
            raise ValueError(f"{file} grows to {size} bytes by its header; up to {limit} are right")
        size = 0
        with into.open("wb") as out:
            for part in _decompressor().read_to_iter(raw):
                size += len(part)
                if size > limit:
                    raise ValueError(f"{file} grows to more than {MAX_TIMES} times its size")
                out.write(part)
    return into
