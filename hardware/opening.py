"""Opening of a board by its URI."""

import difflib
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl

from eitskin.errors import ConfigurationError
from eitskin.hardware.boards.board import Board


def open_board(uri: str, **options: Any) -> Board:
    """Open the board that `uri` names.

    Args:
        uri: "serial:/dev/ttyACM0", "text:/dev/ttyACM0?protocol=pairwise:8", "virtual:" or
            "replay:DIRECTORY"; options of its own may follow, as in "virtual:?speed=max&seed=1".
        options: the same options, for values that are not text.

    Raises:
        ConfigurationError: for an unknown URI or option, or an option out of range.
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
"""Parser of each option's text; None for options that have no text form."""


def _require_known(scheme: str, name: str, readers: Readers) -> None:
    if name not in readers:
        raise ConfigurationError(f"{scheme}: has no option {name!r}; it has {', '.join(readers)}")


def _read_options(scheme: str, query: str, readers: Readers) -> dict[str, Any]:
    """Options of a URI's query, parsed."""
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
    from eitskin.hardware.boards.port import connector
    from eitskin.hardware.boards.serial_board import SerialBoard

    return SerialBoard(connector(path, uri, **options), uri)


def _open_text(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.boards.text_board import open_text

    return open_text(path, uri, **options)


def _open_virtual(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.virtual.virtual_board import open_virtual

    if path:
        meant = path if "=" in path else f"scene={path}"
        raise ConfigurationError(
            f"virtual: takes options and no path, got {uri!r}; write virtual:?{meant}"
        )
    return open_virtual(uri, **options)


def _open_replay(path: str, uri: str, options: dict[str, Any]) -> Board:
    from eitskin.hardware.boards.replay_board import ReplayBoard

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
            "protocol": str,
            "fixture": str,
            "mechanics": str,
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
