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
    readers = _SCHEMES[scheme]
    read = _read_options(scheme, query, readers)
    for name in options:
        _require_known(scheme, name, readers)
    return _open(scheme, path, uri, read | options)


def _open(scheme: str, path: str, uri: str, options: dict[str, Any]) -> Board:
    """Board of a kind; only what it needs is imported."""
    if scheme == "serial":
        from eitskin.hardware.boards.serial_board import open_serial

        return open_serial(path, uri, **options)
    if scheme == "text":
        from eitskin.hardware.boards.text_board import open_text

        return open_text(path, uri, **options)
    if scheme == "virtual":
        from eitskin.hardware.virtual.virtual_board import open_virtual_uri

        return open_virtual_uri(path, uri, **options)
    from eitskin.hardware.boards.replay_board import ReplayBoard

    return ReplayBoard(path, uri, **options)


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


_SCHEMES: dict[str, Readers] = {
    "serial": {"baud": int, "usb": str},
    "text": {"baud": int, **dict.fromkeys(("protocol", "usb", "mark"), str)}
    | dict.fromkeys(("pause", "frequency"), float),
    "virtual": dict.fromkeys(("speed", "resolution", "scene", "sensor", "protocol"), str)
    | dict.fromkeys(("fixture", "mechanics", "instrument", "faults", "link"), str)
    | {"seed": int, "snr_db": float, "period": float, "simulator": None},
    "replay": {"speed": str},
}
"""Options of each kind of board."""
