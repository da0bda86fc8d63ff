"""A process of its own that writes a bag, so that neither the disk nor the format costs a tick.

It is used as a ``McapWriter`` is, and uses one. What was flushed is in its hands: it outlives
whoever recorded, and closes the bag when that ends, in whatever way. Pure.

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
"""What it is, the channel, the time in ns, and how many bytes follow."""
_CHANNEL, _MESSAGE, _FLUSH, _CLOSE = range(4)
_MAX_BYTES = 1 << 20
"""Handed over at the latest, flush or no flush: bounds the memory."""
_PIPE_BYTES = 1 << 20
"""What lies between the two processes: so much that a flush does not wait for the other one."""
CLOSE_S = 60.0
"""Wall time the process has to write what it was given last."""


class BagWriter(Protocol):
    """What messages are written to: a ``McapWriter``, or a ``WriterProcess`` that has one."""

    def channel(self, topic: str, kind: str) -> int:
        """Return the number under which messages of a topic are written."""
        ...

    def write(self, channel: int, ns: int, data: bytes) -> None:
        """Write a message."""
        ...

    def flush(self) -> None:
        """Bring everything where it outlives this process."""
        ...

    def close(self, custom: Mapping[str, str] | None = None) -> None:
        """End the bag well."""
        ...


class WriterProcess:
    """Hands messages to a process that writes them."""

    def __init__(self, options: BagOptions) -> None:
        """Make the bag's folder, which must not be there yet, and start the process.

        Raises:
            BagError: the folder is there already or cannot be made.
            MissingError: a library that bags need is not installed.
        """
        need("rosbags", "mcap", why="for bags")  # the process would die of it unheard
        self.folder = options.folder
        self._channels: dict[tuple[str, str], int] = {}
        self._records = bytearray()
        make_folder(options.folder)
        self._said: Any = tempfile.TemporaryFile()  # noqa: SIM115  what it says when it fails
        # A session of its own: Ctrl-C is for who records; this ends when there is no more to read.
        self._process = subprocess.Popen(
            [*module_command(__name__), json.dumps([str(options.folder.resolve()), *options[1:]])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            start_new_session=True,
        )
        with contextlib.suppress(OSError):  # a system may grant less; then a flush may wait
            fcntl.fcntl(self._process.stdin, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)  # type: ignore[arg-type]
        self._open, self._ready = True, False

    def channel(self, topic: str, kind: str) -> int:
        """Return the number under which messages of a topic are written.

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
            BagError: the process has ended: the disk is full, or the like.
        """
        records = self._records
        records += _RECORD.pack(_MESSAGE, channel, ns, len(data))
        records += data
        if len(records) > _MAX_BYTES:
            self._hand_over()

    def _put(self, what: int, channel: int, data: bytes) -> None:
        self._records += _RECORD.pack(what, channel, 0, len(data))
        self._records += data

    def flush(self) -> None:
        """Hand everything over, to be brought to the disk as one whole.

        Raises:
            BagError: the process has ended: the disk is full, or the like.
        """
        self._put(_FLUSH, 0, b"")
        self._hand_over()

    def _hand_over(self) -> None:
        if not self._open:
            raise BagError(f"the bag {self.folder} is closed")
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if not self._ready:  # begun with: a tick later on must not wait for a Python to start
            self._ready = bool(self._process.stdout.readline())
        try:
            self._process.stdin.write(self._records)
            self._process.stdin.flush()
        except BrokenPipeError:
            self._failed()
        self._records.clear()

    def close(self, custom: Mapping[str, str] | None = None) -> None:
        """End the bag well; closing twice is once.

        Args:
            custom: what ``metadata.yaml`` says under ``custom_data``.

        Raises:
            BagError: it was not ended well: the disk is full, or the like.
        """
        if not self._open:
            return
        self._put(_CLOSE, 0, json.dumps(dict(custom or {})).encode())
        self._hand_over()
        self._end()
        if self._process.returncode:
            self._failed()
        self._said.close()

    def abandon(self) -> None:
        """Let go: the process ends the bag with what it was given."""
        if self._open:
            self._end()
            self._said.close()

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
        """Say what the process said last."""
        if self._open:
            self._end()
        self._said.seek(0)
        said = self._said.read().decode(errors="replace").strip()
        self._said.close()
        raise BagError(
            said
            or f"what writes {self.folder} was killed; `ember bag repair {self.folder}` "
            "brings back what is in it"
        )


def _write(records: BinaryIO, writer: McapWriter) -> None:
    """Write records until there are no more.

    Where and when it was goes into ``metadata.yaml``, so that the files of the same run are the
    same.
    """
    where = provenance()
    channels: dict[int, int] = {}
    while len(head := records.read(_RECORD.size)) == _RECORD.size:
        what, channel, ns, length = _RECORD.unpack(head)
        data = records.read(length)
        if len(data) < length:
            break  # who recorded was killed in the middle of it
        if what == _MESSAGE:
            writer.write(channels[channel], ns, data)
        elif what == _FLUSH:
            writer.flush()
        elif what == _CHANNEL:
            channels[channel] = writer.channel(*json.loads(data))
        else:
            writer.close({**where, **json.loads(data)})
    writer.close(where)  # does nothing after a close


def main() -> int:
    """Write what comes on standard input; return 2, and say why, if it cannot be written."""
    folder, *how = json.loads(sys.argv[1])
    try:
        writer = McapWriter(BagOptions(Path(folder), *how), made=True)
        print("ready", flush=True)
        with os.fdopen(sys.stdin.fileno(), "rb", 1 << 20, closefd=False) as records:
            _write(records, writer)
    except BagError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
