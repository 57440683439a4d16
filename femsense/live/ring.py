"""Frames from one process to another through shared memory, without locks; old frames are overwritten.

Each slot has a counter that is odd during a write. A reader copies the slot and keeps the copy only if the counter
is unchanged and the checksum matches, so that neither process waits for a lock that the other might hold when it dies.
"""

from __future__ import annotations

import struct
import zlib
from multiprocessing.shared_memory import SharedMemory

from femsense.core.errors import InputError

SLOT = struct.Struct("<QQI")
"""Counter, size of the frame and its checksum."""
SLOTS = 8


class Ring:
    """A ring of frames in shared memory with one writer and one reader."""

    def __init__(self, slot_bytes: int, name: str, *, is_new: bool, slots: int = SLOTS) -> None:
        """Create a ring, or attach to an existing one.

        Arguments:
            slot_bytes: size of the largest frame [bytes].
            name: of the shared memory, known to both processes.
            is_new: whether to create it.
            slots: number of frames that it holds.
        """
        self.slot_bytes, self.slots, self.name = slot_bytes, slots, name
        self._is_own = is_new
        self._memory = SharedMemory(name, create=is_new, size=slots * (SLOT.size + slot_bytes))
        self._count = 0

    def write(self, data: bytes) -> int:
        """Overwrite the oldest frame; return the ticket for `read`. Raises InputError if the frame exceeds a slot."""
        if len(data) > self.slot_bytes:
            raise InputError(
                "a frame is larger than the ring's slots",
                where="ring",
                found=f"{len(data)} bytes",
                expected=f"≤ {self.slot_bytes}",
            )
        ticket, at = self._count, self._place(self._count)
        memory = self._buffer
        SLOT.pack_into(memory, at, 2 * ticket + 1, len(data), zlib.crc32(data))
        memory[at + SLOT.size : at + SLOT.size + len(data)] = data
        SLOT.pack_into(memory, at, 2 * ticket + 2, len(data), zlib.crc32(data))
        self._count += 1
        return ticket

    def read(self, ticket: int) -> bytes | None:
        """Return the frame of a ticket; None if it was overwritten."""
        at = self._place(ticket)
        memory = self._buffer
        counter, size, checksum = SLOT.unpack_from(memory, at)
        if counter != 2 * ticket + 2 or size > self.slot_bytes:
            return None
        data = bytes(memory[at + SLOT.size : at + SLOT.size + size])
        same = SLOT.unpack_from(memory, at)[0] == counter
        return data if same and zlib.crc32(data) == checksum else None

    def close(self) -> None:
        """Release the memory; its creator removes it."""
        self._memory.close()
        if self._is_own:
            self._memory.unlink()

    @property
    def _buffer(self) -> memoryview:
        buffer = self._memory.buf
        assert buffer is not None
        return buffer

    def _place(self, ticket: int) -> int:
        return (ticket % self.slots) * (SLOT.size + self.slot_bytes)
