"""Seals: a SHA-256 of everything before it, in a line at the end of a shard's file.

HDF5 checks the values of arrays and not its own tables, where a flipped bit may turn values into
zeros, keep a reader busy for ever or end the process. A seal is compared before HDF5 looks at the
file. HDF5 passes over what follows the end that it has noted, and a program that changes the file
cuts the seal off, so that a file without one is old or was changed on purpose.
"""

import hashlib
import re
import struct

from eitskin.errors import DataError

_SEAL = re.compile(rb"\neitskin seal 1 sha256 ([0-9a-f]{64})\n")
_LENGTH = len("\neitskin seal 1 sha256 \n") + 64
_SUPERBLOCK = b"\x89HDF\r\n\x1a\n\x00"  # of version 0, which h5py writes; then sizes, and addresses
_END = struct.Struct("<40xQ")


def sealed(image: bytes) -> bytes:
    """Content of a file: an HDF5 file and its seal."""
    return image + b"\neitskin seal 1 sha256 " + hashlib.sha256(image).hexdigest().encode() + b"\n"


def unsealed(content: bytes) -> tuple[bytes, bool]:
    """HDF5 file of a content, and whether it was sealed; raises DataError for a broken seal."""
    image, tail = content[:-_LENGTH], content[-_LENGTH:]
    if match := _SEAL.fullmatch(tail):
        if hashlib.sha256(image).hexdigest() != match[1].decode():
            raise DataError(
                "this is not a whole shard: its content is not the one that was sealed; make or "
                "copy it again"
            )
        return image, True
    if content.startswith(_SUPERBLOCK) and len(content) > _END.size:
        (end,) = _END.unpack_from(content)
        if len(content) > end:
            raise DataError(
                f"this is not a whole shard: expected its end or a whole seal after {end} bytes, "
                f"got {len(content) - end} other bytes; make or copy it again"
            )
    return content, False
