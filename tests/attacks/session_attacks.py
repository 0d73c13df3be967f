"""Attacks on a session: forged pipelines, damaged frames, clocks set back, network bytes."""

import contextlib
import dataclasses
import functools
import json
import random
import re
import shutil
import socket
import time
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from websockets.sync.client import connect

from eitskin.errors import EitskinError
from eitskin.hardware import run_live
from eitskin.hardware.streams import reading_record
from eitskin.simulator import Frame
from eitskin.training import open_pipeline
from eitskin.training.pipeline.saved_form import DOCUMENT, GOLDEN, SHIPPED_PATH, SUMS

from live_fakes import FakeBoard
from page_fakes import ask


class AcceptedDamageError(Exception):
    """Damage that was taken for data."""


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Bytes with one to three changes: bits, counts, cuts, pages, copies."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at, other = rng.randrange(len(content) or 1), rng.randrange(len(content) or 1)
        length = rng.choice((1, 1, 4, 8, 64, 512))
        piece = rng.choice(
            (
                bytes([content[at] ^ 1 << rng.randrange(8)]) if content else b"",
                rng.choice((b"\0", b"\xff")) * length,
                rng.choice((1 << 31, 1 << 40, (1 << 64) - 1, 127, 65535)).to_bytes(8, "little"),
                content[other : other + length],
            )
        )
        content = rng.choice(
            (content[:at] + piece + content[at + len(piece) :],) * 4 + (content[:at],)
        )
    return content


@functools.cache
def pipeline() -> Any:
    """The shipped pipeline."""
    return open_pipeline(SHIPPED_PATH)


def rest_frame(of: Any, numbers: np.random.Generator, count: int) -> Frame:
    """Frame of a sensor at rest, with noise."""
    noise = 1 + 2e-4 * numbers.standard_normal(len(of.layout.reference))
    values = (of.layout.reference * noise).astype(complex)
    return Frame(values, of.layout.protocol, 0.3 * count, count, frequency=of.layout.frequency)


def damaged_frame(good: Frame, rng: random.Random) -> Frame:
    """Frame with odd values, times, numbers or status."""
    numbers = np.random.default_rng(rng.randrange(2**32))
    values, count = good.impedance.copy(), len(good.impedance)
    chosen = numbers.random(count) < rng.choice((0.04, 0.5, 1.0))
    odd = numbers.choice([np.nan, np.inf, -np.inf, 0, -1, 1e300, 1e-300, 5e-324, 1e12, 1j], count)
    with np.errstate(all="ignore"):
        values = rng.choice(
            (
                np.where(chosen, odd, values),
                np.where(chosen, -values, values),
                np.where(chosen, values * 10 ** numbers.uniform(-12, 12), values),
                values * np.exp(2j * np.pi * rng.random()),
                numbers.permutation(values),
                values * (1 + 0.2 * numbers.standard_normal(count)),
            )
        )
    status = numbers.integers(0, 256, count).astype(np.uint8) * (chosen & (rng.random() < 0.2))
    time_, number = rng.choice(
        ((good.time, good.number),) * 3 + ((-1e10, 0), (np.nan, -5), (1e300, 2**40))
    )
    return dataclasses.replace(good, impedance=values, status=status, time=time_, number=number)


def pipelines(rng: random.Random, folder: Path) -> None:
    """Open a saved pipeline whose document or arrays were changed, under sums that are right."""
    from safetensors.numpy import load, save

    path = folder / "changed.eitmodel"
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(SHIPPED_PATH, path)
    name = rng.choice((DOCUMENT, DOCUMENT, DOCUMENT, "weights.safetensors", GOLDEN))
    content = (path / name).read_bytes()
    if name == DOCUMENT:
        document = json.loads(content)
        place: Any = document
        key = rng.choice(list(place))
        while isinstance(place[key], dict | list) and place[key] and rng.random() < 0.7:
            place = place[key]
            key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
        choices = (
            None,
            True,
            -1,
            1e300,
            10**30,
            "",
            "$(touch X):M",
            "a;b:C",
            [],
            {},
            ["touch", "idle"],
            2.5,
        )
        place[key] = rng.choice(choices)
        content = json.dumps(document).encode()
    elif rng.random() < 0.5:
        arrays = {name: np.atleast_1d(array).copy() for name, array in load(content).items()}
        chosen = rng.choice(list(arrays))
        if rng.random() < 0.3:
            arrays = rng.choice(
                ({}, {chosen: arrays[chosen]}, {n: a[:0] for n, a in arrays.items()})
            )
        elif arrays[chosen].size:
            with contextlib.suppress(ValueError, OverflowError):
                value = rng.choice((np.nan, np.inf, 1e30))
                arrays[chosen].flat[rng.randrange(arrays[chosen].size)] = value
        content = save(arrays)
    else:
        head = 8 + int.from_bytes(content[:8], "little")
        content = damaged(content[:head], rng) + content[head:]
    (path / name).write_bytes(content)
    lines = (SHIPPED_PATH / SUMS).read_text().splitlines()
    digest = sha256(content).hexdigest()
    lines = [digest + line[64:] if line.endswith(name) else line for line in lines]
    (path / SUMS).write_text("\n".join(lines) + "\n")
    try:
        opened = open_pipeline(path)
    except EitskinError as error:
        words = str(error).partition("--method ")[2]
        if re.match(r"[^']*[$;`|&]", words.partition(" (in")[0]):
            raise AcceptedDamageError(f"not quoted: {error}") from error
        raise
    rate = opened.process(rest_frame(opened, np.random.default_rng(0), 0))
    if not isinstance(rate.bend_angle_deg, float | None):
        raise AcceptedDamageError(f"bend_angle_deg is {rate.bend_angle_deg!r}")


def live(rng: random.Random, folder: Path, frames: int = 100) -> None:  # noqa: ARG001
    """Run a session of frames most of which are damaged, by a clock that is set back."""
    pipeline().reset()
    draws = np.random.default_rng(rng.randrange(2**32))

    def source() -> Iterator[Frame]:
        for number in range(frames):
            good = rest_frame(pipeline(), draws, number)
            yield good if number == 0 or rng.random() < 0.3 else damaged_frame(good, rng)

    clock = lambda: rng.choice((time.perf_counter(), 0.0, -1e9, 1e12))  # noqa: E731
    steps = time.time if rng.random() < 0.5 else clock
    with mock.patch("time.time", steps):
        for reading in run_live(FakeBoard(source()), pipeline(), clock=clock):
            if reading.problem.startswith("the pipeline failed"):
                raise ArithmeticError(reading.problem)
            json.dumps(reading_record(reading, FakeBoard.counts), allow_nan=False)
            estimate = reading.estimate
            found = (
                []
                if estimate is None
                else [estimate.bend_angle_deg or 0.0, *np.ravel(estimate.touches)]
            )
            if estimate is not None and not (estimate.problems or np.isfinite(found).all()):
                raise ArithmeticError(f"not finite, without a problem: {estimate}")


@functools.cache
def servers() -> tuple[Any, Any]:
    """A live page and a stream by WebSocket, of all trials; the page waits for nobody."""
    from eitskin.cli.page.live_page import LivePage
    from eitskin.cli.page.server import ClientLimits
    from eitskin.hardware.streams import WebSocketOutlet

    from page_fakes import DESIGN, FakeConnection

    page = LivePage(FakeConnection(), DESIGN, limits=ClientLimits(send=0.2, receive=0.1))
    page.__enter__()
    return page, WebSocketOutlet("127.0.0.1", 0)


def websocket_frames(rng: random.Random) -> bytes:
    """Frames of WebSocket with at most one thing wrong each: bits, kinds, lengths, texts."""
    sent = b""
    for _ in range(rng.randrange(1, 5)):
        body = rng.choice(
            (b"", b"{}", b"\xff\xfe", b"\x03\xe8", b"\0\1", rng.randbytes(125), b"a" * 2000)
        )
        head, length = rng.choice((0x81, 0x82, 0x89, 0x8A, 0x88, 0x01, 0x80)), len(body)
        wrong = rng.random()
        if wrong < 0.2:
            head = rng.randrange(256)  # reserved bits and kinds, fragments of nothing
        elif wrong < 0.4:
            length = rng.choice((0, 126, 2**16, 2**40, 2**63, 2**64 - 1))
        mask = rng.choice((0x80, 0x80, 0x80, 0))
        small = bytes([mask | length]) if length < 126 else b""
        long = length.to_bytes(2 if length < 2**16 else 8, "big")
        sent += bytes([head]) + (small or bytes([mask | (126 if len(long) == 2 else 127)]) + long)
        key = rng.randbytes(4) if mask else b""
        sent += key + (bytes(b ^ key[n % 4] for n, b in enumerate(body)) if mask else body)
    return sent


def network(rng: random.Random, folder: Path) -> None:  # noqa: ARG001
    """Send damaged requests and frames to the live page and to the stream by WebSocket."""
    page, stream = servers()
    url = rng.choice((page, stream)).url
    port = int(url.rstrip("/").rpartition(":")[2])
    hello = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    text = rng.choice(("<script>alert(1)</script>", "\\ud800", "a" * 3000, "\\u202e", "idle"))
    path, body = rng.choice(
        (
            ("/scene", '{"bend_deg": 5, "touches": [{"x": 0.05, "y": 0.02, "force": 1e400}]}'),
            ("/scene", "[" * 3000),
            ("/fault", f'{{"fault": "{text}"}}'),
            ("/enter", f'{{"token": "{text}"}}'),
        )
    )
    post = (
        f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: {url.rstrip('/')}\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n{body}"
    )
    sent = hello.encode() if url.startswith("ws") or rng.random() < 0.3 else post.encode()
    with socket.create_connection(("127.0.0.1", port), timeout=0.5) as client:
        client.sendall(sent if rng.random() < 0.6 else damaged(sent, rng))
        with contextlib.suppress(OSError):
            if url.startswith("ws"):
                stream.send("{}")
                client.recv(4096)
                client.sendall(websocket_frames(rng))
            if rng.random() < 0.3:
                client.shutdown(socket.SHUT_WR)
            client.recv(65536)
    if rng.random() < 0.05:
        if ask(page, "GET", "/")[0] != 200:
            raise AcceptedDamageError("the page serves nobody any more")
        stream.send("{}")
        with connect(stream.url) as listener:
            listener.recv(20.0)
