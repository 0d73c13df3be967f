"""Opening of a board by its URI."""

import difflib
from collections.abc import Callable, Mapping
from importlib import import_module
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
    function, readers = _SCHEMES[scheme]
    read = _read_options(scheme, query, readers)
    for name in options:
        _require_known(scheme, name, readers)
    module, _, name = function.rpartition(".")
    opener = getattr(import_module(f"eitskin.hardware.{module}"), name)
    board: Board = opener(path, uri, **read | options)
    return board


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


_SCHEMES: dict[str, tuple[str, Readers]] = {
    "serial": ("boards.serial_board.open_serial", {"baud": int, "usb": str}),
    "text": (
        "boards.text_board.open_text",
        {"baud": int, **dict.fromkeys(("protocol", "usb", "mark"), str)}
        | dict.fromkeys(("pause", "frequency"), float),
    ),
    "virtual": (
        "virtual.virtual_board.open_virtual_uri",
        dict.fromkeys(("speed", "resolution", "scene", "sensor", "protocol", "fixture"), str)
        | dict.fromkeys(("mechanics", "instrument", "faults", "link"), str)
        | {"seed": int, "snr_db": float, "period": float, "simulator": None},
    ),
    "replay": ("boards.replay_board.ReplayBoard", {"speed": str}),
}
"""Function that opens a board, called with path, URI and options, and the options' readers."""
