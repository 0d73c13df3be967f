"""The live page of `eitskin live --page`: its contents as plain data for JSON, and its readers."""

import dataclasses
import json
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin import hardware, simulator
from eitskin.cli.page.access import Access
from eitskin.cli.page.commands import (
    BEND_RANGE,
    FORCE_RANGE,
    MAX_TOUCHES,
    SessionCommands,
    stage_commands,
)
from eitskin.cli.page.drawing import (
    DrawnPress,
    GelDrawing,
    Region,
    encode_numbers,
    grid_spacing,
    plan_outline,
)
from eitskin.closeable import Closeable
from eitskin.extras import require_all
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.live import AcquisitionClock
from eitskin.hardware.streams import bad_channels, state_name, zero_name

if TYPE_CHECKING:
    from eitskin.cli.live_pictures import Picture
    from eitskin.cli.page.server import ClientLimits

log = logging.getLogger(__name__)

MIN_SILENCE = 1.0  # s; a machine that is busy for a moment is no silence
HEARTBEAT = 1.0  # s
MAX_UPDATE_RATE = 60  # more than a screen shows
MEMORY_PACE = 0.2  # s between two frames of the page's past, which a browser that comes late gets
MAX_MOMENTS = 3000  # of a recording
MOMENT_PERIOD = 0.2  # s between two moments of a recording, at least


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Reading with the board's counts and the session's reference frame.

    Attributes:
        reading: reading from the live loop.
        counts: counts of the board at that moment.
        reference: first frame of the session, from which changes of channels count.
        begun: start of the frame's measurement by the page's clock [s]; NaN where unknown.
        published: arrival of the reading by the page's clock [s].
    """

    reading: "hardware.Reading"
    counts: "hardware.Counts"
    reference: Frame
    begun: float = math.nan
    published: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class PageContent:
    """Conversion of one board's readings to plain data.

    Attributes:
        board: source of the readings.
        sheet: its sensor, or the region of positions on one of unknown geometry.
        drawing: three-dimensional drawing of the sensor; None where its geometry is unknown.
    """

    board: "hardware.Board"
    sheet: "SensorDesign | Region"
    drawing: GelDrawing | None

    @classmethod
    def from_board(cls, board: "hardware.Board", sheet: "SensorDesign | Region") -> "PageContent":
        """Contents for a board with a sensor."""
        return cls(
            board, sheet, None if isinstance(sheet, Region) else GelDrawing.from_design(sheet)
        )

    def sensor(self) -> dict[str, Any]:
        """Plain data of the sensor, which does not change while the page is open."""
        sheet, board = self.sheet, self.board
        known = None if isinstance(sheet, Region) else sheet
        region = sheet if isinstance(sheet, Region) else Region.from_design(sheet)
        outline = plan_outline(known) if known else region.corners
        return {
            "uri": board.uri,
            "firmware": board.info.firmware,
            "period": _finite_or_none(board.info.period, 6),
            "origin": list(region.low),
            "length": region.length,
            "width": region.width,
            "thickness": known and known.thickness,
            "outline": np.round(outline, 5).tolist(),
            "grid": grid_spacing(region.length, region.width),
            "electrodes": [
                (round(each.x, 5), round(each.y, 5)) for each in (known.electrodes if known else ())
            ],
            "labels": list(board.protocol.labels),
            "shape": None if self.drawing is None else self.drawing.as_dict(),
            "controls": self._controls(),
        }

    def _controls(self) -> dict[str, Any] | None:
        """Ranges of the controls of a virtual board; None with a real board."""
        if getattr(self.board, "stage", None) is None:
            return None
        from eitskin.hardware.virtual.fault_table import FAULTS

        return {
            "bend": list(BEND_RANGE),
            "force": list(FORCE_RANGE),
            "touches": MAX_TOUCHES,
            "faults": list(FAULTS),
        }

    def frame(self, snapshot: Snapshot) -> dict[str, Any]:
        """Plain data of one reading; null stands for unknown values."""
        reading, counts = snapshot.reading, snapshot.counts
        frame = reading.frame
        return {
            "number": frame.number,
            "session": frame.session,
            "time": _finite_or_none(frame.time, 3),
            "rate": _finite_or_none(reading.rate, 2),
            "latency_ms": _finite_or_none(1e3 * reading.latency, 2),
            "begun": _finite_or_none(snapshot.begun, 4),
            "unusable": reading.unusable,
            "frames": counts.frames,
            "lost": counts.lost,
            "skipped": counts.skipped,
            "dropped": dict(counts.dropped),
            "reconnections": counts.reconnections,
            "channels": relative_change(frame, snapshot.reference),
            "bad": bad_channels(frame),
            "problem": reading.problem,
            "estimate": None if reading.estimate is None else self._estimate(reading.estimate),
            "stage": self.stage(frame.number),
        }

    def _estimate(self, estimate: "hardware.Estimate") -> dict[str, Any]:
        presses, touches = found_presses(estimate), estimate.touches
        angle = math.nan if estimate.bend_angle_deg is None else float(estimate.bend_angle_deg)
        return {
            "state": state_name(estimate),
            "probabilities": [_finite_or_none(float(p), 4) for p in estimate.probabilities],
            "angle": _finite_or_none(angle, 3),
            "deviation": _finite_or_none(getattr(estimate, "bend_deviation_deg", None), 3),
            "map": None if estimate.touch_map is None else pixels(estimate.touch_map),
            "picture": signed_pixels(getattr(estimate, "picture", None)),
            "touches": touches
            and [
                {
                    "x": _finite_or_none(x, 5),
                    "y": _finite_or_none(y, 5),
                    "strength": _finite_or_none(strength, 3),
                    "force": _finite_or_none(press[2], 2),
                }
                for (x, y, strength), press in zip(touches, presses, strict=True)
            ],
            "zero": zero_name(estimate),
            "problems": list(estimate.problems),
            "points": "" if self.drawing is None else self.drawing.points(angle, presses),
        }

    def stage(self, number: int | None = None) -> dict[str, Any] | None:
        """Commanded scene, faults, and true scene of frame `number` of a virtual board."""
        stage = getattr(self.board, "stage", None)
        if stage is None:
            return None
        truth = None if number is None else stage.truth(number)
        return {
            "commanded": _scene(stage.scene),
            "truth": None if truth is None else _scene(truth),
            "faults": list(stage.faults),
        }


def recorded_moments(
    board: "hardware.ReplayBoard",
    pipeline: "hardware.FramePipeline",
    sheet: "SensorDesign | Region",
) -> list[dict[str, Any]]:
    """Plain data of a recording's frames, `MAX_MOMENTS` at most, with times from its first [s].

    Its pipeline processes no more frames than are shown.
    """
    content = PageContent.from_board(board, sheet)
    board.pause = max(MOMENT_PERIOD, board.duration / MAX_MOMENTS)
    reference: Frame | None = None
    moments: list[dict[str, Any]] = []
    offset = newest = math.nan
    for reading in hardware.run_live(board, pipeline):
        frame = reading.frame
        if reference is None or reference.session != frame.session:
            begin = 0.0 if reference is None else newest + board.pause
            offset = begin - frame.time
        reference = next_reference(reference, frame)
        newest = offset + frame.time
        snapshot = Snapshot(reading, board.counts, reference)
        moments.append(content.frame(snapshot) | {"time": _finite_or_none(newest, 3)})
    return moments


def next_reference(reference: Frame | None, frame: Frame) -> Frame:
    """Frame from which changes count, as of `frame`: the first of its session, made whole."""
    if reference is None or reference.session != frame.session:
        return frame
    return fill_bad_channels(reference, frame) if reference.status.any() else reference


def fill_bad_channels(reference: Frame, frame: Frame) -> Frame:
    """Reference whose bad channels are replaced by good ones of `frame`."""
    better = (reference.status != 0) & (frame.status == 0)
    return dataclasses.replace(
        reference,
        impedance=np.where(better, frame.impedance, reference.impedance),
        status=np.where(better, frame.status, reference.status),
    )


def relative_change(frame: Frame, reference: Frame) -> list[float | None]:
    """Change of the real part of each channel from the reference [%]; None where unknown."""
    now, then = frame.impedance, reference.impedance
    with np.errstate(all="ignore"):
        change = 100.0 * np.real((now - then) / then)
    return [_finite_or_none(float(value), 3) for value in change]


def found_presses(estimate: "hardware.Estimate") -> list[DrawnPress]:
    """x [m], y [m] and force [N] of each estimated touch; NaN where the force is not estimated."""
    return [
        (float(touch[0]), float(touch[1]), float(getattr(touch, "force", math.nan)))
        for touch in estimate.touches or ()
    ]


def pixels(touch_map: NDArray[np.floating]) -> dict[str, Any] | None:
    """Map, 0 to 1, as bytes in base64, first row first; None for an empty map."""
    values = np.nan_to_num(np.asarray(touch_map, dtype=float))
    if not values.any():
        return None
    return _image(255.0 * np.clip(values, 0.0, 1.0))


def signed_pixels(picture: "Picture | None") -> dict[str, Any] | None:
    """Picture as bytes in base64, first row first: 1 to 255, 128 for no change or outside."""
    if picture is None:
        return None
    share = np.nan_to_num(picture.values) / picture.limit
    image = _image(128.0 + 127.0 * np.clip(share, -1.0, 1.0))
    return image | {"limit": _finite_or_none(picture.limit, 8)}


def _image(levels: NDArray[np.float64]) -> dict[str, Any]:
    rows, columns = levels.shape
    return {"rows": rows, "columns": columns, "data": encode_numbers(np.rint(levels), "u1")}


def _scene(scene: "simulator.Scene") -> dict[str, Any]:
    touches = [touch for touch in scene.touches if not touch.released]
    return {
        "bend_deg": _finite_or_none(scene.bend.angle_deg, 3),
        "touches": [
            {
                "x": _finite_or_none(touch.x, 5),
                "y": _finite_or_none(touch.y, 5),
                "force": _finite_or_none(touch.force, 2) if touch.depth is None else None,
            }
            for touch in touches
        ],
    }


def _finite_or_none(value: float | None, digits: int) -> float | None:
    """`value` in few digits, None where it is unknown or not finite, which JSON cannot say."""
    return round(float(value), digits) if value is not None and math.isfinite(value) else None


class LivePage(Closeable):
    """Server of the page and its newest reading; there is no queue, so nothing is late.

    The live loop publishes readings; threads of the page encode and send these, so that browsers
    cannot slow the loop.

    Attributes:
        url: address of the page, without a token.
        invitations: permissions, each with its address.
    """

    def __init__(
        self,
        connection: "hardware.Connection",
        sheet: SensorDesign | Region,
        port: int = 0,
        access: Access | None = None,
        session: SessionCommands | None = None,
        limits: "ClientLimits | None" = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start to serve.

        Args:
            connection: connection to the board whose readings will be published; a virtual one can
                be commanded by the page.
            sheet: design of its sensor, or the region of positions where that is not known.
            port: 0 for any that is free.
            access: address to serve at, and who may use the page; without it this machine.
            session: takes what is asked of the live session; without it nothing is.
            limits: limits with browsers.
            clock: [s].

        Raises ConfigurationError where the port cannot be had.
        """
        require_all(live="starlette uvicorn")
        from eitskin.cli.page.server import ClientLimits, Server

        board = connection.board
        self._connection, self._clock = connection, clock
        self._content = PageContent.from_board(board, sheet)
        self._acquired = AcquisitionClock()
        self._newest: Snapshot | None = None
        self._arrived = self._told = self._closed = False
        self._changed = threading.Condition()
        hello = b"retry: 1000\n" + event(
            "sensor",
            self._content.sensor() | {"tasks": None if session is None else list(session.commands)},
        )
        self._session = session
        self.server = Server(
            port,
            access or Access(),
            hello,
            {**stage_commands(board, sheet), **({} if session is None else session.commands)},
            limits or ClientLimits(),
        )
        self.url = self.server.access.url(self.server.port)
        self.invitations = self.server.access.invitations(self.server.port)
        self._thread = threading.Thread(target=self._send_events, name="page", daemon=True)
        self._thread.start()

    def publish(self, reading: "hardware.Reading") -> None:
        """Make this reading the next one that the page shows; returns at once."""
        counts, now, frame = self._connection.board.counts, self._clock(), reading.frame
        begun = self._acquired.measurement_start(frame, now - reading.latency)
        with self._changed:
            before = self._newest
            reference = next_reference(None if before is None else before.reference, frame)
            self._newest, self._arrived = Snapshot(reading, counts, reference, begun, now), True
            self._changed.notify()

    def tell(self) -> None:
        """Send what has changed other than the readings; returns at once."""
        with self._changed:
            self._told = True
            self._changed.notify()

    def close(self) -> None:
        if self._closed:
            return
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self.server.close()

    def _send_events(self) -> None:
        """Encode each newest reading once, and the connection's health while none comes."""
        sent = -1.0 / MAX_UPDATE_RATE
        remembered = -MEMORY_PACE
        while True:
            snapshot = self._wait(sent)
            if self._closed:
                return
            sent = self._clock()
            memorable = snapshot is not None and sent - remembered >= MEMORY_PACE
            if not self.server.watching and not memorable:
                continue
            try:
                self.server.send(self._message(snapshot), memorable)
                remembered = sent if memorable else remembered
            except Exception:  # the page must outlive whatever a pipeline comes up with
                log.exception("the page cannot show frame")

    def _wait(self, sent_time: float) -> Snapshot | None:
        """Wait for a reading or the next heartbeat, no more often than a screen shows.

        The newest reading; None where that was taken before.
        """
        with self._changed:
            pause = sent_time + 1.0 / MAX_UPDATE_RATE - self._clock()
            if pause > 0.0:
                self._changed.wait_for(lambda: self._closed, pause)
            self._changed.wait_for(
                lambda: self._closed or self._arrived or self._told, self._heartbeat_delay()
            )
            newest = self._newest if self._arrived else None
            self._arrived = self._told = False
            return newest

    def _heartbeat_delay(self) -> float:
        """Time without a reading until the page is reported [s]."""
        age = self._age()
        remaining = self.max_age() - age if age is not None else 0.0
        return min(remaining, HEARTBEAT) if remaining > 0.0 else HEARTBEAT

    def max_age(self) -> float:
        """Age at which the newest reading is stale [s]; a text board's period is learned late."""
        from eitskin.hardware.boards.board import longest_silence

        return longest_silence(self._connection.board.info.period, MIN_SILENCE)

    def _age(self) -> float | None:
        """Age of the newest reading [s]; None without a reading."""
        return None if self._newest is None else self._clock() - self._newest.published

    def _message(self, snapshot: Snapshot | None) -> bytes:
        age = self._age()
        health = {
            "sent": round(self._clock(), 4),
            "age": None if age is None else round(age, 3),
            "stale": age is None or age >= self.max_age(),
            "connection": self._connection.problem,
            "tasks": None if self._session is None else self._session.state(),
        }
        if snapshot is None:
            return event("health", {**health, "stage": self._content.stage()})
        return event("frame", {**health, **self._content.frame(snapshot)})


def event(name: str, data: dict[str, Any]) -> bytes:
    """Server-sent event; raises ValueError for numbers that are not finite."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return f"event: {name}\ndata: {text}\n\n".encode()
