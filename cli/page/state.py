"""Contents of the live page as plain data for JSON: the sensor once, then each frame."""

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin import hardware, simulator
from eitskin.cli.page.commands import BEND_RANGE, FORCE_RANGE, MAX_TOUCHES
from eitskin.cli.page.drawing import DrawnPress, GelDrawing, encode_numbers
from eitskin.cli.page.plan import Region, grid_spacing, plan_outline
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.streams import bad_channels, state_name, zero_name

if TYPE_CHECKING:
    from eitskin.cli.live_pictures import Picture


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
