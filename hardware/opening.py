"""Opening of a board by its URI."""

import difflib
import importlib.metadata
import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any, Final
from urllib.parse import parse_qsl

from eitskin.errors import ConfigurationError
from eitskin.hardware.boards.board import Board

GROUP: Final = "eitskin.boards"
"""Group of the entry points by which installed packages offer kinds of boards."""

_PORT: Final = re.compile(r"(?:/dev/[^?]+|COM\d{1,3})(?:\?.*)?")


def open_board(uri: str, **options: Any) -> Board:
    """Open the board that `uri` names.

    Args:
        uri: "serial:/dev/ttyACM0", "text:/dev/ttyACM0?protocol=pairwise:8", "virtual:" or
            "replay:DIRECTORY"; options of its own may follow, as in "virtual:?speed=max&seed=1". A
            path of a port alone is serial:, and text: with protocol=. A package may offer further
            kinds by the entry points `eitskin.boards`: its function gets the path, the URI and the
            options as text, and gives a `Board`.
        options: the same options, for values that are not text.

    Raises:
        ConfigurationError: for an unknown URI or option, or an option out of range.
        DeviceError: where the port is missing, in use, or no board answers as expected.
        DataError: for a recording that cannot be replayed.

    Example:
        >>> from eitskin.hardware import open_board
        >>> with open_board("virtual:?speed=max&resolution=coarse") as board:
        ...     len(board.protocol.table)
        28
    """
    if _PORT.fullmatch(uri):
        uri = f"{'text' if 'protocol=' in uri else 'serial'}:{uri}"
    scheme, _, address = uri.partition(":")
    path, _, query = address.partition("?")
    if not is_board(uri):
        known_schemes = {*_SCHEMES, *_installed_boards()}
        near = difflib.get_close_matches(scheme, known_schemes, n=1)
        hint = f"; did you mean '{near[0]}:'?" if near else ""
        raise ConfigurationError(
            f"expected a board as serial:PORT, text:PORT?protocol=..., virtual: or replay:DIRECTORY"
            f"{''.join(f', {name}:' for name in _installed_boards())}, got {uri!r}{hint}"
        )
    if scheme not in _SCHEMES:
        kind, options = _installed_boards()[scheme].load(), dict(parse_qsl(query)) | options
        try:
            inspect.signature(kind).bind(path, uri, **options)
        except TypeError as error:
            raise ConfigurationError(f"{scheme}: cannot be opened so: {error}") from error
        board = kind(path, uri, **options)
        if not isinstance(board, Board):
            raise ConfigurationError(
                f"{scheme}: must give an eitskin.hardware.Board, got {type(board).__name__}"
            )
        return board
    readers = _SCHEMES[scheme]
    read = _read_options(scheme, query, readers)
    for name in options:
        _require_known(scheme, name, readers)
    return _open(scheme, path, uri, read | options)


def is_board(text: str) -> bool:
    """Whether a text names a board: a port, or a URI of a kind that is known or installed."""
    scheme, colon, _ = text.partition(":")
    has_scheme = bool(colon) and (scheme in _SCHEMES or scheme in _installed_boards())
    return has_scheme or bool(_PORT.fullmatch(text))


def _installed_boards() -> dict[str, importlib.metadata.EntryPoint]:
    """Kinds of boards that installed packages offer."""
    return {point.name: point for point in importlib.metadata.entry_points(group=GROUP)}


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
            raise ConfigurationError(f"{scheme}: option {name} cannot be given in a URI")
        try:
            options[name] = reader(text)
        except ValueError as error:
            raise ConfigurationError(
                f"{scheme}: option {name} must be a number, got {text!r}"
            ) from error
    return options


_SCHEMES: dict[str, Readers] = {
    "serial": {"baud": int, "usb": str},
    "text": {"baud": int, "skip": int, **dict.fromkeys(("protocol", "usb", "mark", "pairs"), str)}
    | dict.fromkeys(("pause", "frequency"), float),
    "virtual": dict.fromkeys(("speed", "resolution", "scene", "sensor", "protocol"), str)
    | dict.fromkeys(("fixture", "mechanics", "instrument", "faults", "link"), str)
    | {"seed": int, "snr_db": float, "period": float, "simulator": None},
    "replay": {"speed": str},
}
"""Options of each kind of board."""
