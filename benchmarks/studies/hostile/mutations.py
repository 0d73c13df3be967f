"""Mutations of good inputs: bytes, and texts of TOML, JSON and tables, changed at random."""

import random
import re
import struct
from collections.abc import Callable
from typing import Final

EXTREMES: Final = (
    *("nan", "inf", "-inf", "-0.0", "0", "-1", "5e-324", "1e-310", "1e-30", "1e-9", "1e9", "1e30"),
    *("1e308", "-1e308", "1e400", "1000000000000", "9" * 20, "9" * 400, "9" * 5000, "true", "null"),
    *('""', '"\\u0000"', "[]", "{}", "[" * 2000, "[" * 200_000, '"' + "x" * 200_000 + '"'),
    *("[[1], [2, 3]]", "1979-05-27", "0x7fffffffffffffff", '"\\ud800"', '"\\u001b]0;x\\u0007"'),
)
"""Values in place of a number of a text."""

TOKENS: Final = (
    *(
        b"\0",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\r",
        b"\n\n",
        b'"',
        b"'",
        b",",
        b";",
        b"\t",
        b"{",
        b"]",
    ),
    *(b"nan", b"-inf", b"1e999", b"-0", b"%n%s", b"../../etc/passwd", b"/dev/zero", b"\x1b[2J"),
    *(
        b"__proto__",
        b"\xed\xa0\x80",
        b"\xf0\x9f\x92\xa9",
        b"=1+1",
        b"#REF!",
        b"<!DOCTYPE a [",
        b"&",
    ),
)
"""Bytes that are put into an input."""

LONGEST: Final = 20_000_000
"""About the most characters of a text, more than readers of TOML take."""

_COUNTS: Final = (0, 1, 127, 128, 255, 256, 32767, 32768, 65535, 2**31 - 1, 2**31, 2**32 - 1)
_COUNTS_64: Final = (*_COUNTS, 2**32, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_PAGE: Final = 4096  # bytes
_NUMBER: Final = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.])")
_QUOTED: Final = re.compile(r'"[^"\n]*"')


def damaged(rng: random.Random, content: bytes) -> bytes:
    """Bytes with one to three changes: bits, pages, lengths, tokens, cuts or copies."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        content = rng.choice(_CHANGES)(rng, content or b"\0")
    return content


def _flipped(rng: random.Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 4, 32))):
        changed[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _filled(rng: random.Random, content: bytes) -> bytes:
    """Bytes replaced by zeros or ones: some, or a whole page."""
    place, length = rng.randrange(len(content)), rng.choice((1, 4, 16, 512, _PAGE))
    if length == _PAGE:
        place -= place % _PAGE
    fill = rng.choice((b"\0", b"\xff")) * min(length, len(content) - place)
    return content[:place] + fill + content[place + length :]


def _recounted(rng: random.Random, content: bytes) -> bytes:
    """Bytes replaced by an integer, as counts, lengths and addresses are written."""
    form = rng.choice(("<B", "<H", "<I", "<Q", ">H", ">I", ">Q"))
    size = struct.calcsize(form)
    number = rng.choice([each for each in _COUNTS_64 if each < 1 << 8 * size])
    place = rng.randrange(len(content))
    return content[:place] + struct.pack(form, number) + content[place + size :]


def _cut(rng: random.Random, content: bytes) -> bytes:
    return content[: rng.randrange(len(content))]


def _spliced(rng: random.Random, content: bytes) -> bytes:
    """Part lost, repeated, or copied to another place."""
    place, other = rng.randrange(len(content)), rng.randrange(len(content))
    length = rng.choice((1, 4, 16, 512, _PAGE))
    part = content[other : other + length]
    return rng.choice(
        (
            content[:place] + content[place + length :],
            content[:place] + part + content[place:],
            content[:place] + part + content[place + length :],
            content[:place] + rng.randbytes(length) + content[place:],
            content[:place] + content[place // 2 :],
        )
    )


def _with_token(rng: random.Random, content: bytes) -> bytes:
    place = rng.randrange(len(content))
    return content[:place] + rng.choice(TOKENS) * rng.choice((1, 1, 1000)) + content[place:]


_CHANGES: Final[tuple[Callable[[random.Random, bytes], bytes], ...]] = (
    *(_flipped, _flipped, _flipped, _filled, _filled, _recounted, _recounted),
    *(_cut, _spliced, _spliced, _with_token),
)


def misworded(rng: random.Random, text: str) -> str:
    """Text with numbers or strings replaced by extremes, lines changed, or bytes damaged."""
    return rng.choice(_REWORDINGS)(rng, text)


def _renumbered(rng: random.Random, text: str) -> str:
    return _replaced(rng, text, _NUMBER, lambda _: rng.choice(EXTREMES))


def _renamed(rng: random.Random, text: str) -> str:
    """Strings with tokens in them, or other values in their place."""

    def other(string: str) -> str:
        token = rng.choice(TOKENS).decode(errors="surrogateescape").encode(errors="replace")
        inside = string[:-1] + rng.choice((token.decode(), "\\u0000", "x" * 70_000)) + '"'
        return rng.choice((inside, rng.choice(EXTREMES)))

    return _replaced(rng, text, _QUOTED, other)


def _replaced(
    rng: random.Random, text: str, pattern: re.Pattern[str], other: Callable[[str], str]
) -> str:
    for _ in range(rng.choice((1, 1, 3))):
        found = list(pattern.finditer(text))
        if not found:
            return _relined(rng, text)
        match = rng.choice(found)
        text = text[: match.start()] + other(match[0]) + text[match.end() :]
    return text


def _relined(rng: random.Random, text: str) -> str:
    """Text with a line lost, doubled, swapped, or replaced."""
    lines = text.splitlines() or [""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    many = min(3000, LONGEST // (1 + len(lines[at])) + 1)
    changed = [[], [lines[at]] * 2, [lines[other]], [rng.choice(EXTREMES)], [lines[at]] * many]
    return "\n".join([*lines[:at], *rng.choice(changed), *lines[at + 1 :]])


def _damaged_text(rng: random.Random, text: str) -> str:
    return damaged(rng, text.encode()).decode(errors="replace")


_REWORDINGS: Final[tuple[Callable[[random.Random, str], str], ...]] = (
    *(_renumbered, _renumbered, _renumbered, _renamed, _relined, _damaged_text),
)
