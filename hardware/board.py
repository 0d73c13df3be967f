"""Boards: what they give, and how one is opened by its URI."""

import difflib
import math
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self
from urllib.parse import parse_qsl

from eitskin.geometry import ConfigurationError
from eitskin.hardware.messages import Info
from eitskin.hardware.stage import Stage
from eitskin.simulator import Frame, Protocol


@dataclass(frozen=True, slots=True)
class Counts:
    """What has come through and what has not.

    Attributes:
        frames: given out.
        lost: missing by their numbers; never made up.
        skipped: good, but older than the newest when the newest was asked for.
        dropped: byte strings and messages thrown away, by reason.
        reconnections: how often it has gone away and come back.
    """

    frames: int = 0
    lost: int = 0
    skipped: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    reconnections: int = 0


SILENT_PERIODS = 3
SHORTEST_SILENCE = 0.5  # s; a host that is busy for a moment is no silent board


def silence_after(period: float, least: float = SHORTEST_SILENCE) -> float:
    """How long no frame may come from a board with that period [s]; NaN or 0 is unknown."""
    return max(SILENT_PERIODS * period, least) if period > 0.0 else math.inf


class Board(typing.Protocol):
    """A source of frames: a board on a port, a virtual one, or a recording of one."""

    @property
    def uri(self) -> str:
        """What it was opened as."""

    @property
    def info(self) -> Info:
        """Who it is."""

    @property
    def protocol(self) -> Protocol:
        """What it measures."""

    @property
    def counts(self) -> Counts:
        """What has come through so far."""

    @property
    def stage(self) -> Stage | None:
        """What happens to a virtual board; None where nobody can say."""

    @property
    def lost(self) -> int:
        """Frames lost so far."""

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """The frames, as they come; with `newest`, those that another has overtaken are left out.

        Raises DeviceError where the board falls silent or goes away.
        """

    def calibrate(self) -> None:
        """Have it measure its calibration resistor again; raises where it cannot."""

    def reconnect(self) -> None:
        """Connect again, after which `frames` goes on; raises DeviceError where that fails."""

    def close(self) -> None:
        """Stop and let go of the port; a second time does nothing."""

    def __enter__(self) -> Self:
        """Give the board itself."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the board."""


def open_board(uri: str, **options: Any) -> Board:
    """Open the board that `uri` names.

    Args:
        uri: "serial:/dev/ttyACM0", "text:/dev/ttyACM0?protocol=pairwise:8", "virtual:" or
            "replay:DIRECTORY"; options of its own may follow, as in "virtual:?speed=max&seed=1".
        options: the same options, for values that are not text.

    Raises:
        ConfigurationError: for a URI or option that cannot be.
        DeviceError: where the port is missing, in use, or no board answers as expected.
        DataError: for a recording that cannot be replayed.
    """
    scheme, colon, rest = uri.partition(":")
    if not colon or scheme not in _SCHEMES:
        near = difflib.get_close_matches(scheme, _SCHEMES, n=1)
        hint = f"; did you mean '{near[0]}:'?" if near else ""
        raise ConfigurationError(
            f"expected a board as serial:PORT, text:PORT, virtual: or replay:DIRECTORY, got "
            f"{uri!r}{hint}"
        )
    path, _, query = rest.partition("?")
    opener, readers = _SCHEMES[scheme]
    for name in options:
        _require_known(scheme, name, readers)
    return opener(path, uri, _read_options(scheme, query, readers) | options)


Readers = Mapping[str, Callable[[str], Any] | None]
"""What reads each option from text; None where text cannot say it."""


def _require_known(scheme: str, name: str, readers: Readers) -> None:
    if name not in readers:
        raise ConfigurationError(f"{scheme}: has no option {name!r}; it has {', '.join(readers)}")


def _read_options(scheme: str, query: str, readers: Readers) -> dict[str, Any]:
    """The options in a URI's query, each read by its reader."""
    options = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        _require_known(scheme, name, readers)
        reader = readers[name]
        if reader is None:
            raise ConfigurationError(f"{scheme}: option {name} cannot be said in a URI")
        try:
            options[name] = reader(text)
        except ValueError as error:
            raise ConfigurationError(
                f"{scheme}: option {name} must be a number, got {text!r}"
            ) from error
    return options


def _open_serial(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.port import connector
    from eitskin.hardware.serial_board import SerialBoard

    return SerialBoard(connector(path, uri, **options), uri)


def _open_text(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.text_board import open_text

    return open_text(path, uri, **options)


def _open_virtual(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.virtual import open_virtual

    if path:
        raise ConfigurationError(
            f"virtual: takes options and no path, got {uri!r}; write virtual:?scene={path}"
        )
    return open_virtual(uri, **options)


def _open_replay(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.replay import ReplayBoard

    return ReplayBoard(path, uri, **options)


_SCHEMES: dict[str, tuple[Callable[[str, str, dict[str, Any]], Board], Readers]] = {
    "serial": (_open_serial, {"baud": int, "usb": str}),
    "text": (
        _open_text,
        {
            "protocol": str,
            "baud": int,
            "usb": str,
            "mark": str,
            "pause": float,
            "frequency": float,
        },
    ),
    "virtual": (
        _open_virtual,
        {
            "speed": str,
            "resolution": str,
            "scene": str,
            "sensor": str,
            "seed": int,
            "snr_db": float,
            "instrument": str,
            "faults": str,
            "period": float,
            "link": str,
            "simulator": None,
        },
    ),
    "replay": (_open_replay, {"speed": str}),
}
