"""Writes a bag in a process of its own, so that no tick waits for the disk or the format.

It has the interface of ``McapWriter``, and uses one. The process receives every flushed message,
outlives the recorder, and closes the bag when the recorder ends, however it ends. Pure.

    python -m ember_ros.bag.writer_process '["DIR", 0.0, 0.0]' < records
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, Protocol

from ember_ros.bag.storage import BagOptions, McapWriter, make_folder
from ember_ros.children import module_command
from ember_ros.errors import BagError, need
from ember_ros.versions import provenance

_RECORD = struct.Struct("<BHqI")
"""Kind, channel, time in ns, and how many bytes follow."""
_CHANNEL, _MESSAGE, _FLUSH, _CLOSE = range(4)
_MAX_BYTES = 1 << 20
"""Of records that are sent without a flush: this bounds the memory."""
_PIPE_BYTES = 1 << 20
"""Of the pipe between the two processes: so many that a flush does not wait."""
CLOSE_S = 60.0
"""Wall time in which the process must write the last messages."""


class BagWriter(Protocol):
    """What writes messages: a ``McapWriter``, or a ``WriterProcess`` that has one."""

    def channel(self, topic: str, kind: str) -> int:
        """Return the channel of a topic."""
        ...

    def write(self, channel: int, ns: int, data: bytes) -> None:
        """Write a message."""
        ...

    def flush(self) -> None:
        """Send or write all messages, so that they outlive this process."""
        ...

    def close(self, custom: Mapping[str, str] | None = None) -> None:
        """Close the bag."""
        ...


class WriterProcess:
    """Sends messages to a process that writes them."""

    def __init__(self, options: BagOptions) -> None:
        """Make the bag's folder, which must not exist yet, and start the process.

        Raises:
            BagError: the folder exists already or cannot be made.
            MissingError: a library that bags need is not installed.
        """
        need("rosbags", "mcap", why="for bags")  # else the process would fail later
        self.folder = options.folder
        self._channels: dict[tuple[str, str], int] = {}
        self._records = bytearray()
        make_folder(options.folder)
        self._stderr: Any = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process
        # A session of its own: Ctrl-C goes to the recorder; this process ends with its input.
        self._process = subprocess.Popen(
            [*module_command(__name__), json.dumps([str(options.folder.resolve()), *options[1:]])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            start_new_session=True,
        )
        with contextlib.suppress(OSError):  # a system may allow less; then a flush may wait
            fcntl.fcntl(self._process.stdin, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)  # type: ignore[arg-type]
        self._open, self._ready = True, False

    def channel(self, topic: str, kind: str) -> int:
        """Return the channel of a topic.

        Args:
            topic: its absolute name.
            kind: its type, as ``std_msgs/msg/String``.
        """
        channel = self._channels.get((topic, kind))
        if channel is None:
            channel = self._channels[topic, kind] = len(self._channels)
            self._put(_CHANNEL, channel, json.dumps([topic, kind]).encode())
        return channel

    def write(self, channel: int, ns: int, data: bytes) -> None:
        """Write a message.

        Raises:
            BagError: the process has ended, for example because the disk is full.
        """
        records = self._records
        records += _RECORD.pack(_MESSAGE, channel, ns, len(data))
        records += data
        if len(records) > _MAX_BYTES:
            self._send()

    def _put(self, kind: int, channel: int, data: bytes) -> None:
        self._records += _RECORD.pack(kind, channel, 0, len(data))
        self._records += data

    def flush(self) -> None:
        """Send all messages, which the process writes to the disk as one chunk.

        Raises:
            BagError: the process has ended, for example because the disk is full.
        """
        self._put(_FLUSH, 0, b"")
        self._send()

    def _send(self) -> None:
        if not self._open:
            raise BagError(f"the bag {self.folder} is closed")
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if not self._ready:
            # Wait at the first flush: later ticks must not wait for Python to start.
            self._ready = bool(self._process.stdout.readline())
        try:
            self._process.stdin.write(self._records)
            self._process.stdin.flush()
        except BrokenPipeError:
            self._failed()
        self._records.clear()

    def close(self, custom: Mapping[str, str] | None = None) -> None:
        """Close the bag; safe to call twice.

        Args:
            custom: ``custom_data`` of ``metadata.yaml``.

        Raises:
            BagError: it could not be closed, for example because the disk is full.
        """
        if not self._open:
            return
        self._put(_CLOSE, 0, json.dumps(dict(custom or {})).encode())
        self._send()
        self._end()
        if self._process.returncode:
            self._failed()
        self._stderr.close()

    def abandon(self) -> None:
        """Stop sending: the process closes the bag with what it has received."""
        if self._open:
            self._end()
            self._stderr.close()

    def _end(self) -> None:
        self._open = False
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.stdout.close()
        try:
            self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _failed(self) -> NoReturn:
        """Raise a BagError with the process's last message."""
        if self._open:
            self._end()
        self._stderr.seek(0)
        message = self._stderr.read().decode(errors="replace").strip()
        self._stderr.close()
        raise BagError(
            message
            or f"the process that writes {self.folder} was killed; `ember bag repair "
            f"{self.folder}` restores what is in it"
        )


def _write(records: BinaryIO, writer: McapWriter) -> None:
    """Write records until the input ends.

    The provenance goes into ``metadata.yaml`` only, so that the same run makes the same MCAP files.
    """
    custom = provenance()
    channels: dict[int, int] = {}
    while len(head := records.read(_RECORD.size)) == _RECORD.size:
        kind, channel, ns, length = _RECORD.unpack(head)
        data = records.read(length)
        if len(data) < length:
            break  # the recorder was killed while sending it
        if kind == _MESSAGE:
            writer.write(channels[channel], ns, data)
        elif kind == _FLUSH:
            writer.flush()
        elif kind == _CHANNEL:
            channels[channel] = writer.channel(*json.loads(data))
        else:
            writer.close({**custom, **json.loads(data)})
    writer.close(custom)  # does nothing after a close


def main() -> int:
    """Write the records of standard input; print the error and return 2 if that fails."""
    folder, *splits = json.loads(sys.argv[1])
    try:
        writer = McapWriter(BagOptions(Path(folder), *splits), made=True)
        print("ready", flush=True)
        with os.fdopen(sys.stdin.fileno(), "rb", 1 << 20, closefd=False) as records:
            _write(records, writer)
    except BagError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
