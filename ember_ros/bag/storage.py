"""Writes the files of a bag as the tools of Jazzy expect them: MCAP, and ``metadata.yaml``.

Messages are written as serialized bytes, at times that the caller passes: the same messages make
the same files. ``flush`` ends a chunk: flushed messages outlive this process. ``metadata.yaml`` is
written last: a bag without it was cut off, and ``repair`` restores its flushed messages.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import yaml

from ember_ros.bag.guard import MAX_TEXT, check_file, load_yaml
from ember_ros.bounded_io import read_text
from ember_ros.errors import PIP, BagError

METADATA = "metadata.yaml"
STORAGES = {"mcap": ".mcap", "sqlite3": ".db3"}
"""The storages that can be read, and the suffixes of their files; ours is the first."""
STORAGE = "mcap"
LOCK_S = 5.0
"""Wall time to wait for another process that is just closing the bag."""
VERSION = 9
"""Of ``metadata.yaml``, as Jazzy writes it."""
_INFINITE = {"sec": 9223372036, "nsec": 854775807}
QOS = [
    {
        "history": "keep_last",
        "depth": 1,
        "reliability": "reliable",
        "durability": "transient_local",
        "deadline": _INFINITE,
        "lifespan": _INFINITE,
        "liveliness": "automatic",
        "liveliness_lease_duration": _INFINITE,
        "avoid_ros_namespace_conventions": False,
    }
]
"""``offered_qos_profiles`` of all topics: ``topics.latest`` with rosbag2's names."""


class Definition(NamedTuple):
    """The definition of a message type, for readers that do not have the type."""

    text: str
    """The ``.msg`` file and all types that it uses."""
    rihs01: str
    """The type's hash (REP 2016)."""
    encoding: str = "ros2msg"
    """The format of the text."""


def needs_rosbags(error: ModuleNotFoundError) -> BagError:
    """Return the error for a missing library."""
    return BagError(
        f"bags need rosbags and mcap ({error}): `pip install {PIP['rosbags']} {PIP['mcap']}`"
    )


@functools.cache
def definition(kind: str) -> Definition:
    """Return the definition of a message type of Jazzy, named as ``std_msgs/msg/String``."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise needs_rosbags(error) from error
    store = get_typestore(Stores.ROS2_JAZZY)
    if kind not in store.fielddefs:
        raise BagError(f"the message type {kind} is not part of Jazzy")
    return Definition(store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind))


def _yaml(content: Any) -> str:
    class Plain(yaml.SafeDumper):
        def ignore_aliases(self, data: Any) -> bool:
            return True

    return yaml.dump(content, Dumper=Plain, sort_keys=False)


class _Mcap:
    """Writes an MCAP file: one chunk per flush, compressed, with a CRC."""

    def __init__(self, path: Path) -> None:
        from mcap.writer import CompressionType, Writer

        self._out = path.open("xb")
        # Chunks end only at a flush, so that the number of ticks alone decides where.
        self._writer: Any = Writer(self._out, chunk_size=1 << 40, compression=CompressionType.ZSTD)
        self._writer.start("ros2")
        self._schemas: dict[tuple[str, Definition], int] = {}
        self._channels: dict[int, int] = {}

    def add(self, channel: int, topic: str, kind: str, of: Definition, qos: Sequence[Any]) -> None:
        if (kind, of) not in self._schemas:
            self._schemas[kind, of] = self._writer.register_schema(
                kind, of.encoding, of.text.encode()
            )
        metadata = {"offered_qos_profiles": _yaml(list(qos)).strip(), "topic_type_hash": of.rihs01}
        self._channels[channel] = self._writer.register_channel(
            topic, "cdr", self._schemas[kind, of], metadata
        )

    def write(self, channel: int, ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[channel], ns, data, ns)

    def flush(self) -> None:
        self._writer.flush()

    def size(self) -> int:
        return self._out.tell()

    def close(self) -> None:
        # Without the bag's metadata: that has file names, and the same run must make the same
        # bytes under any name.
        self._writer.finish()
        self._out.close()

    def abandon(self) -> None:
        # The buffered rest may not fit on the disk: close the descriptor all the same.
        with contextlib.suppress(OSError):
            self._out.close()


class _Span:
    """Count and times of the messages in a file."""

    __slots__ = ("count", "first", "last", "name")

    def __init__(self, name: str) -> None:
        self.name, self.count = name, 0
        self.first, self.last = 1 << 63, 0


def _extent(spans: list[_Span]) -> dict[str, Any]:
    """Return the extent of some files together, with the keys of ``metadata.yaml``."""
    spans = [span for span in spans if span.count]
    first = min((span.first for span in spans), default=0)
    last = max((span.last for span in spans), default=0)
    return {
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": sum(span.count for span in spans),
    }


class BagOptions(NamedTuple):
    """Where a bag is written, and when a new file begins."""

    folder: Path
    split_mb: float = 0.0
    """Megabytes after which a new file begins; 0 never."""
    split_s: float = 0.0
    """Seconds of the bag's time after which a new file begins; 0 never."""


def make_folder(folder: Path) -> None:
    """Make the folder of a new bag.

    Raises:
        BagError: it exists already, or cannot be made.
    """
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise BagError(
            f"{folder} is there already, and a bag is never overwritten; give another name, or "
            "remove it"
        ) from None
    except OSError as error:
        raise BagError(f"cannot make the bag {folder}: {error.strerror}") from error


def lock(folder: Path) -> int:
    """Lock a bag for writing, and return the descriptor that holds the lock.

    Raises:
        BagError: another process is writing this bag.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    deadline = time.monotonic() + LOCK_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() < deadline:
                # Its recorder was killed, and its writer process closes it.
                time.sleep(LOCK_S / 100)
                continue
            os.close(descriptor)
            raise BagError(f"{folder} is being written now; stop the recording first") from None
        return descriptor


def size_of(folder: Path) -> int:
    """Return how many bytes are in the files of a bag."""
    size = 0
    for file in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # the draft of the metadata is renamed
            size += file.stat().st_size
    return size


class McapWriter:
    """Writes messages into the files of a bag."""

    def __init__(self, options: BagOptions, *, made: bool = False) -> None:
        """Make the folder, which must not exist yet, and the first file in it.

        Args:
            options: of the bag.
            made: whether the caller has made the folder already.

        Raises:
            BagError: the folder exists already or cannot be made, or a library is missing.
        """
        folder, split_mb, split_s = options
        self.folder = folder
        self._split_bytes, self._split_ns = split_mb * 1e6, split_s * 1e9
        self._channels: dict[tuple[str, str], int] = {}
        self._definitions: list[tuple[Definition, Sequence[Any]]] = []  # with QoS, by channel
        self._counts: list[int] = []
        self._spans: list[_Span] = []
        self._file: _Mcap | None = None
        self._full = False
        if not made:
            make_folder(folder)
        self._lock = lock(folder)
        self._open_file()

    @contextlib.contextmanager
    def _wrap_errors(self) -> Iterator[None]:
        """Raise a BagError for an error of the disk, and close the files."""
        try:
            yield
        except ModuleNotFoundError as error:
            self.abandon()
            raise needs_rosbags(error) from error
        except OSError as error:
            self._fail(error)

    def _open_file(self) -> None:
        name = f"{self.folder.resolve().name}_{len(self._spans)}{STORAGES[STORAGE]}"
        with self._wrap_errors():
            self._file = _Mcap(self.folder / name)
            for (topic, kind), channel in self._channels.items():
                self._file.add(channel, topic, kind, *self._definitions[channel])
        self._spans.append(_Span(name))

    def channel(
        self,
        topic: str,
        kind: str,
        of: Definition | None = None,
        qos: Sequence[Any] = QOS,
    ) -> int:
        """Return the channel of a topic.

        Args:
            topic: its absolute name.
            kind: its type, as ``std_msgs/msg/String``.
            of: the type's definition; that of Jazzy for None.
            qos: ``offered_qos_profiles``, with rosbag2's names.

        Raises:
            BagError: the bag cannot be written, for example because the disk is full; it is closed.
        """
        channel = self._channels.get((topic, kind))
        if channel is None:
            of = of or definition(kind)  # raises for an unknown type before any change
            file = self._opened()
            channel = self._channels[topic, kind] = len(self._counts)
            self._counts.append(0)
            self._definitions.append((of, qos))
            with self._wrap_errors():
                file.add(channel, topic, kind, of, qos)
        return channel

    def _opened(self) -> _Mcap:
        if self._full:  # only now: no file stays empty
            self.begin_file()
        if self._file is None:
            raise BagError(f"the bag {self.folder} is closed")
        return self._file

    def write(self, channel: int, ns: int, data: bytes) -> None:
        """Write a message.

        Args:
            channel: of its topic.
            ns: its time, ns.
            data: the serialized message.

        Raises:
            BagError: the bag cannot be written, for example because the disk is full; it is closed.
        """
        try:
            self._opened().write(channel, ns, data)
        except OSError as error:
            self._fail(error)
        self._counts[channel] += 1
        span = self._spans[-1]
        span.count += 1
        if ns > span.last:
            span.last = ns
        if ns < span.first:
            span.first = ns

    def flush(self) -> None:
        """Write all messages to the disk as one chunk; begin a new file if this one is full.

        Raises:
            BagError: the bag cannot be written, for example because the disk is full; it is closed.
        """
        if self._file is None:
            return
        with self._wrap_errors():
            self._file.flush()
            span = self._spans[-1]
            full = 0 < self._split_bytes <= self._file.size()
        self._full = span.count > 0 and (full or 0 < self._split_ns <= span.last - span.first)

    def begin_file(self) -> None:
        """Close the current file, and begin another.

        Raises:
            BagError: the bag cannot be written, for example because the disk is full; it is closed.
        """
        self._full = False
        if self._file is not None:
            with self._wrap_errors():
                self._file.close()
            self._open_file()

    @property
    def messages(self) -> int:
        """Return the number of messages written."""
        return sum(self._counts)

    def _metadata(self, custom: Mapping[str, str]) -> dict[str, Any]:
        """Return the content of ``metadata.yaml`` below its only key."""
        return {
            "version": VERSION,
            "storage_identifier": STORAGE,
            **_extent(self._spans),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": kind,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": list(self._definitions[channel][1]),
                        "type_description_hash": self._definitions[channel][0].rihs01,
                    },
                    "message_count": self._counts[channel],
                }
                for (topic, kind), channel in self._channels.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [span.name for span in self._spans],
            "files": [{"path": span.name, **_extent([span])} for span in self._spans],
            "custom_data": dict(custom) or None,
            "ros_distro": "jazzy",
        }

    def close(self, custom: Mapping[str, str] | None = None) -> None:
        """Close the bag; safe to call twice.

        Args:
            custom: ``custom_data`` of ``metadata.yaml``.

        Raises:
            BagError: the bag cannot be written, for example because the disk is full.
        """
        if self._file is None:
            return
        metadata = self._metadata(custom or {})
        with self._wrap_errors():
            self._file.close()
            self._file, self._full = None, False
            write_metadata(self.folder, metadata)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def abandon(self) -> None:
        """Close the files as they are: the bag is cut off."""
        file, self._file = self._file, None
        self._full = False
        if file is not None:
            file.abandon()
        self._unlock()

    def _fail(self, error: Exception) -> NoReturn:
        self.abandon()
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise BagError(
            f"cannot write the bag {self.folder}: {why}; it is cut off here, and `ember bag repair "
            f"{self.folder}` restores what is in it"
        ) from error


INFORMATION = "rosbag2_bagfile_information"


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return the content of ``metadata.yaml`` below its only key.

    Raises:
        BagError: it is missing, or has other content.
    """
    file = folder / METADATA
    try:
        if file.exists() and not file.is_file():
            raise BagError(f"cannot read {file}: it is no regular file")
        check_file(file, folder)
        content = load_yaml(read_text(file, MAX_TEXT))[INFORMATION]
        if not isinstance(content, dict):
            raise TypeError(f"{INFORMATION} is a {type(content).__name__}")
    except OSError as error:
        raise BagError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        why = " ".join(str(error).split())
        raise BagError(
            f"{file} is no metadata of a bag ({why}); move it away, and `ember bag repair "
            f"{folder}` writes a new one"
        ) from error
    return content


def write_metadata(folder: Path, content: Mapping[str, Any]) -> None:
    """Write ``metadata.yaml``, completely or not at all."""
    draft = folder / f".{METADATA}"
    try:
        draft.write_text(_yaml({INFORMATION: dict(content)}), encoding="utf-8")
        os.replace(draft, folder / METADATA)
    finally:
        draft.unlink(missing_ok=True)


def seal(folder: Path, **facts: str) -> None:
    """Add entries to ``custom_data`` of a closed bag.

    Raises:
        BagError: it is no closed bag, or cannot be written.
    """
    content = read_metadata(folder)
    content["custom_data"] = {**(content.get("custom_data") or {}), **facts}
    try:
        write_metadata(folder, content)
    except OSError as error:
        raise BagError(f"cannot write {folder / METADATA}: {error.strerror}") from error
