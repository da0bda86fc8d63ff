"""Writes the files of a bag, as the tools of Jazzy expect them: MCAP, and ``metadata.yaml``.

Messages are written as the bytes they travelled as, at times that the caller gives, so that the
same messages make the same files. ``flush`` ends a chunk: what was flushed outlives this process.
``metadata.yaml`` is written last: a bag without it was cut off, and ``repair`` brings back what was
flushed.
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
"""What a bag that is read can be stored as, and the ending of its files; ours are the first."""
STORAGE = "mcap"
LOCK_S = 5.0
"""Wall time to wait for somebody who is just closing a bag."""
VERSION = 9
"""Of ``metadata.yaml``: the one of Jazzy."""
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
"""``offered_qos_profiles`` of all topics: what ``topics.latest`` says, in rosbag2's words."""


class Definition(NamedTuple):
    """What a message type is, for readers that do not know it."""

    text: str
    """Of the ``.msg`` file and of all it uses."""
    rihs01: str
    """The type's hash (REP 2016)."""
    encoding: str = "ros2msg"
    """What kind of text it is."""


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
        raise BagError(f"the message type {kind} is none of those that Jazzy comes with")
    return Definition(store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind))


def _yaml(content: Any) -> str:
    class Plain(yaml.SafeDumper):
        def ignore_aliases(self, data: Any) -> bool:
            return True

    return yaml.dump(content, Dumper=Plain, sort_keys=False)


class _Mcap:
    """An MCAP file: a chunk a flush, compressed, with its CRC."""

    def __init__(self, path: Path) -> None:
        from mcap.writer import CompressionType, Writer

        self._out = path.open("xb")
        # Chunks end where they are flushed, which the number of ticks decides, and nowhere else.
        self._writer: Any = Writer(self._out, chunk_size=1 << 40, compression=CompressionType.ZSTD)
        self._writer.start("ros2")
        self._schemas: dict[tuple[str, Definition], int] = {}
        self._channels: dict[int, int] = {}

    def add(self, channel: int, topic: str, kind: str, of: Definition, qos: Sequence[Any]) -> None:
        if (kind, of) not in self._schemas:
            self._schemas[kind, of] = self._writer.register_schema(
                kind, of.encoding, of.text.encode()
            )
        told = {"offered_qos_profiles": _yaml(list(qos)).strip(), "topic_type_hash": of.rihs01}
        self._channels[channel] = self._writer.register_channel(
            topic, "cdr", self._schemas[kind, of], told
        )

    def write(self, channel: int, ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[channel], ns, data, ns)

    def flush(self) -> None:
        self._writer.flush()

    def size(self) -> int:
        return self._out.tell()

    def close(self) -> None:
        # The metadata stays outside: it names files, and the same run must make the same bytes
        # under any name.
        self._writer.finish()
        self._out.close()

    def abandon(self) -> None:
        # What the file object still holds may not fit: let go of the descriptor all the same.
        with contextlib.suppress(OSError):
            self._out.close()


class _Span:
    """How much is in a file."""

    __slots__ = ("count", "first", "last", "name")

    def __init__(self, name: str) -> None:
        self.name, self.count = name, 0
        self.first, self.last = 1 << 63, 0


def _told(spans: list[_Span]) -> dict[str, Any]:
    """Return what metadata says of files together."""
    spans = [span for span in spans if span.count]
    first = min((span.first for span in spans), default=0)
    last = max((span.last for span in spans), default=0)
    return {
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": sum(span.count for span in spans),
    }


class BagOptions(NamedTuple):
    """Where a bag goes, and how."""

    folder: Path
    split_mb: float = 0.0
    """Megabytes after which a new file begins; 0 never."""
    split_s: float = 0.0
    """Seconds of the bag's own time after which a new file begins; 0 never."""


def make_folder(folder: Path) -> None:
    """Make the folder of a new bag.

    Raises:
        BagError: it is there already, or cannot be made.
    """
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise BagError(
            f"{folder} is there already, and a bag is never written over; give another name, or "
            "remove it"
        ) from None
    except OSError as error:
        raise BagError(f"cannot make the bag {folder}: {error.strerror}") from error


def lock(folder: Path) -> int:
    """Take the lock of a bag that is written, and return the descriptor that holds it.

    Raises:
        BagError: somebody is writing this bag.
    """
    held = os.open(folder, os.O_RDONLY)
    deadline = time.monotonic() + LOCK_S
    while True:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() < deadline:
                time.sleep(LOCK_S / 100)  # who recorded was just killed, and its scribe closes it
                continue
            os.close(held)
            raise BagError(
                f"{folder} is being written at this moment; stop the recording first"
            ) from None
        return held


def size_of(folder: Path) -> int:
    """Return how many bytes are in the files of a bag."""
    size = 0
    for file in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # a draft of the metadata comes and goes
            size += file.stat().st_size
    return size


class McapWriter:
    """Writes a bag: messages in, files out."""

    def __init__(self, options: BagOptions, *, made: bool = False) -> None:
        """Make the folder, which must not be there yet, and the first file in it.

        Args:
            options: where and how.
            made: whether the folder was made for it already.

        Raises:
            BagError: the folder is there already or cannot be made, or a library is missing.
        """
        folder, split_mb, split_s = options
        self.folder = folder
        self._split_bytes, self._split_ns = split_mb * 1e6, split_s * 1e9
        self._channels: dict[tuple[str, str], int] = {}
        self._told: list[tuple[Definition, Sequence[Any]]] = []
        self._counts: list[int] = []
        self._spans: list[_Span] = []
        self._file: _Mcap | None = None
        self._full = False
        if not made:
            make_folder(folder)
        self._lock = lock(folder)
        self._open_file()

    @contextlib.contextmanager
    def _doing(self) -> Iterator[None]:
        """Turn what a disk does to us into a BagError, and let go of the files."""
        try:
            yield
        except ModuleNotFoundError as error:
            self.abandon()
            raise needs_rosbags(error) from error
        except OSError as error:
            self._give_up(error)

    def _open_file(self) -> None:
        name = f"{self.folder.resolve().name}_{len(self._spans)}{STORAGES[STORAGE]}"
        with self._doing():
            self._file = _Mcap(self.folder / name)
            for (topic, kind), channel in self._channels.items():
                self._file.add(channel, topic, kind, *self._told[channel])
        self._spans.append(_Span(name))

    def channel(
        self,
        topic: str,
        kind: str,
        of: Definition | None = None,
        qos: Sequence[Any] = QOS,
    ) -> int:
        """Return the number under which messages of a topic are written.

        Args:
            topic: its absolute name.
            kind: its type, as ``std_msgs/msg/String``.
            of: what the type is; that of Jazzy for None.
            qos: ``offered_qos_profiles``, in rosbag2's words.

        Raises:
            BagError: the disk is full, or the like; the bag is closed as it is.
        """
        channel = self._channels.get((topic, kind))
        if channel is None:
            of = of or definition(kind)  # an unknown type is refused before anything is noted
            file = self._opened()
            channel = self._channels[topic, kind] = len(self._counts)
            self._counts.append(0)
            self._told.append((of, qos))
            with self._doing():
                file.add(channel, topic, kind, of, qos)
        return channel

    def _opened(self) -> _Mcap:
        if self._full:  # only now: no file is begun for nothing
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
            BagError: the disk is full, or the like; the bag is closed as it is.
        """
        try:
            self._opened().write(channel, ns, data)
        except OSError as error:
            self._give_up(error)
        self._counts[channel] += 1
        span = self._spans[-1]
        span.count += 1
        if ns > span.last:
            span.last = ns
        if ns < span.first:
            span.first = ns

    def flush(self) -> None:
        """Bring everything to the disk as one whole, and begin a new file if it is time.

        Raises:
            BagError: the disk is full, or the like; the bag is closed as it is.
        """
        if self._file is None:
            return
        with self._doing():
            self._file.flush()
            span = self._spans[-1]
            full = 0 < self._split_bytes <= self._file.size()
        self._full = span.count > 0 and (full or 0 < self._split_ns <= span.last - span.first)

    def begin_file(self) -> None:
        """End the present file well, and begin another.

        Raises:
            BagError: the disk is full, or the like; the bag is closed as it is.
        """
        self._full = False
        if self._file is not None:
            with self._doing():
                self._file.close()
            self._open_file()

    @property
    def messages(self) -> int:
        """Return how many messages were written."""
        return sum(self._counts)

    def _metadata(self, custom: Mapping[str, str]) -> dict[str, Any]:
        """Return what ``metadata.yaml`` says below its one key."""
        return {
            "version": VERSION,
            "storage_identifier": STORAGE,
            **_told(self._spans),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": kind,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": list(self._told[channel][1]),
                        "type_description_hash": self._told[channel][0].rihs01,
                    },
                    "message_count": self._counts[channel],
                }
                for (topic, kind), channel in self._channels.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [span.name for span in self._spans],
            "files": [{"path": span.name, **_told([span])} for span in self._spans],
            "custom_data": dict(custom) or None,
            "ros_distro": "jazzy",
        }

    def close(self, custom: Mapping[str, str] | None = None) -> None:
        """End the bag well; closing twice is once.

        Args:
            custom: what ``metadata.yaml`` says under ``custom_data``.

        Raises:
            BagError: the disk is full, or the like.
        """
        if self._file is None:
            return
        metadata = self._metadata(custom or {})
        with self._doing():
            self._file.close()
            self._file, self._full = None, False
            write_metadata(self.folder, metadata)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def abandon(self) -> None:
        """Let go of the files as they are: the bag is cut off."""
        file, self._file = self._file, None
        self._full = False
        if file is not None:
            file.abandon()
        self._unlock()

    def _give_up(self, error: Exception) -> NoReturn:
        self.abandon()
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise BagError(
            f"cannot write the bag {self.folder}: {why}; it is cut off here, and `ember bag repair "
            f"{self.folder}` brings back what is in it"
        ) from error


INFORMATION = "rosbag2_bagfile_information"


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return what ``metadata.yaml`` says below its one key.

    Raises:
        BagError: it is missing, or is none.
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
            f"{folder}` makes it anew"
        ) from error
    return content


def write_metadata(folder: Path, content: Mapping[str, Any]) -> None:
    """Write ``metadata.yaml``, whole or not at all."""
    draft = folder / f".{METADATA}"
    try:
        draft.write_text(_yaml({INFORMATION: dict(content)}), encoding="utf-8")
        os.replace(draft, folder / METADATA)
    finally:
        draft.unlink(missing_ok=True)


def seal(folder: Path, **facts: str) -> None:
    """Add to ``custom_data`` what was known only after the bag was closed.

    Raises:
        BagError: it is no closed bag, or cannot be written.
    """
    content = read_metadata(folder)
    content["custom_data"] = {**(content.get("custom_data") or {}), **facts}
    try:
        write_metadata(folder, content)
    except OSError as error:
        raise BagError(f"cannot write {folder / METADATA}: {error.strerror}") from error
