"""Who may see the live page and who may command it: addresses, names and tokens."""

import hmac
import ipaddress
import os
import re
import secrets
import socket
import stat
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Annotated

import typer

from eitskin.cli.options import Output
from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file

LOOPBACK = "127.0.0.1"
_TOKEN_BYTES = 18
_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")
_MAX_FILE = 4096  # bytes


class Role(IntEnum):
    """Permission of a browser; each has those before it."""

    STRANGER = 0
    VIEWER = 1
    COMMANDER = 2


@dataclass(frozen=True, slots=True)
class Tokens:
    """Secrets of a page: who has one may view it, who has the other may command it, too.

    Attributes:
        view, command: letters, digits, `-` and `_`, at least 16.
    """

    view: str = field(repr=False)
    command: str = field(repr=False)

    def __post_init__(self) -> None:
        """Check both."""
        for name in ("view", "command"):
            if not _TOKEN.fullmatch(getattr(self, name)):
                raise ConfigurationError(
                    f"expected a token of 16 to 128 letters, digits, - and _ for {name}, got "
                    "another text; leave the file out to have one made"
                )
        if self.view == self.command:
            raise ConfigurationError("expected two tokens, got the same for view and command")

    @classmethod
    def generate(cls) -> "Tokens":
        """New tokens from the system's randomness."""
        return cls(secrets.token_urlsafe(_TOKEN_BYTES), secrets.token_urlsafe(_TOKEN_BYTES))

    @classmethod
    def load_or_create(cls, path: Path) -> "Tokens":
        """Tokens of a file, which is made where there is none.

        The file has the lines `view TOKEN` and `command TOKEN`. Raises ConfigurationError for
        another file, and for one that others may read.
        """
        if not path.exists():
            tokens = cls.generate()
            with atomic_file(path, mode=0o600) as temporary:
                temporary.write_text(f"view {tokens.view}\ncommand {tokens.command}\n")
            return tokens
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_FILE:
            raise ConfigurationError(f"{path}: expected a file of two tokens, got something else")
        try:
            lines = dict(line.split() for line in path.read_text().splitlines() if line.strip())
            tokens = cls(lines["view"], lines["command"])
        except (ConfigurationError, KeyError, OSError, ValueError) as error:
            reason = f": {error}" if isinstance(error, ConfigurationError) else ""
            raise ConfigurationError(
                f"{path}: expected the lines `view TOKEN` and `command TOKEN`{reason}; name a file "
                "that does not exist, to have it made"
            ) from error
        if os.name == "posix" and status.st_mode & 0o077:
            raise ConfigurationError(
                f"{path}: expected a file that only you may read, got one that others may; "
                f"chmod 600 {path}"
            )
        return tokens

    def role(self, token: str) -> Role:
        """Role of who shows a token, compared in constant time."""
        shown = token.encode()
        commands = hmac.compare_digest(shown, self.command.encode())
        views = hmac.compare_digest(shown, self.view.encode())
        return Role.COMMANDER if commands else Role.VIEWER if views else Role.STRANGER


@dataclass(frozen=True, slots=True)
class Access:
    """Address that a page is served at, and who may use it.

    Attributes:
        host: name or address of a network interface of this machine.
        tokens: None where everybody may command who reaches the page from this machine.
    """

    host: str = LOOPBACK
    tokens: Tokens | None = None

    @classmethod
    def for_host(cls, host: str = LOOPBACK, token_file: Path | None = None) -> "Access":
        """Access without a token only on the loopback interface.

        Raises ConfigurationError for a host that is none, and those of `Tokens.load_or_create`.
        """
        if token_file is not None:
            return cls(host, Tokens.load_or_create(token_file))
        loopback = ipaddress.ip_address(resolve_host(host)[1]).is_loopback
        return cls(host, None if loopback else Tokens.generate())

    def role(self, token: str) -> Role:
        """Role of who shows this token, or an empty one."""
        return Role.COMMANDER if self.tokens is None else self.tokens.role(token)

    def names(self, local: str) -> set[str]:
        """Names that a request may call the page by, which came to an address of this machine.

        An address that it came to was not looked up, so that no foreign name can have been pointed
        at it; of names only those of this machine count.
        """
        at = ipaddress.ip_address(local.partition("%")[0])
        at = getattr(at, "ipv4_mapped", None) or at  # as an IPv6 socket shows an IPv4 address
        names = {_format_host(str(at)), _format_host(self.host)}
        if at.is_loopback:
            names.add("localhost")
        if self.tokens is not None:
            names |= {socket.gethostname(), f"{socket.gethostname()}.local"}
        return {name.lower() for name in names}

    def url(self, port: int) -> str:
        """Address of the page without a token."""
        return f"http://{_format_host(self._display_host())}:{port}/"

    def invitations(self, port: int) -> tuple[tuple[str, str], ...]:
        """Permissions and their addresses; a token follows `#`, which no request shows."""
        if self.tokens is None:
            return (("page", self.url(port)),)
        return (
            ("page, to view", f"{self.url(port)}#{self.tokens.view}"),
            ("page, to view and command", f"{self.url(port)}#{self.tokens.command}"),
        )

    def _display_host(self) -> str:
        """Host of the page's address; one that the network reaches where all are listened at."""
        family, address = resolve_host(self.host)
        if not ipaddress.ip_address(address).is_unspecified:
            return self.host
        foreign = "192.0.2.1" if family == socket.AF_INET else "2001:db8::1"  # for documentation
        with socket.socket(family, socket.SOCK_DGRAM) as asked:
            try:
                asked.connect((foreign, 9))  # sends nothing; the system chooses the interface
                return str(asked.getsockname()[0])
            except OSError:
                return socket.gethostname()


@dataclass(frozen=True)
class PageOptions:
    """Options of the live page."""

    page: Annotated[bool, typer.Option("--page", help="Also serve a page to browsers.")] = False
    page_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 for a free one.")
    ] = 8940
    page_host: Annotated[
        str,
        typer.Option(
            help="Address to serve the page at; 0.0.0.0 for every network, which then needs a "
            "token."
        ),
    ] = LOOPBACK
    page_token_file: Annotated[
        Path | None,
        typer.Option(help="Require access tokens; read them from FILE (created if missing)."),
    ] = None

    @property
    def access(self) -> Access:
        """Address and tokens; raises ConfigurationError as `Access.for_host` does."""
        return Access.for_host(self.page_host, self.page_token_file)


def resolve_host(host: str) -> tuple[socket.AddressFamily, str]:
    """Family and address of a host; raises ConfigurationError for a host that is none."""
    try:
        address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise ConfigurationError(
            f"expected an address or a name of this machine for the page, got {host!r}: {error}; "
            f"{LOOPBACK} serves this machine only, 0.0.0.0 every network that it is in"
        ) from error
    return address[0], str(address[4][0]).partition("%")[0]


def _format_host(host: str) -> str:
    """Host as it stands in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def tell_invitations(invitations: Sequence[tuple[str, str]], output: Output) -> None:
    """Note the addresses of a page.

    Those with tokens are reported nowhere else, and therefore when a command is quiet, too.
    """
    for what, address in invitations:
        if output.quiet and "#" in address:
            typer.echo(f"{what}: {address}", err=True)
        else:
            output.note(f"{what}: {address}", whole=True)
