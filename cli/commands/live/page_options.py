"""Options of commands that serve the live page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin.cli.options import Output

if TYPE_CHECKING:
    from eitskin.cli.page.access import Access
    from eitskin.cli.page.live_page import LivePage

ShowPage = Annotated[bool, typer.Option("--page", help="Also serve a page to browsers.")]
PagePort = Annotated[
    int, typer.Option(min=0, max=65535, help="Port of the page; 0 for a free one.")
]
PageHost = Annotated[
    str,
    typer.Option(
        help="Address to serve the page at; 0.0.0.0 for every network, which then needs a token."
    ),
]
PageTokenFile = Annotated[
    Path | None,
    typer.Option(help="File of the page's two tokens, made where it is not there; asks for them."),
]
PageFolder = Annotated[
    Path, typer.Option(help="Folder of recordings and pipelines that are made from the page.")
]


def tell_page(page: "LivePage", output: Output) -> None:
    """Note the addresses of a page.

    Those with tokens are told nowhere else, and therefore when a command is quiet, too.
    """
    for what, address in page.invitations:
        if output.quiet and "#" in address:
            typer.echo(f"{what}: {address}", err=True)
        else:
            output.note(f"{what}: {address}", whole=True)


def page_access(host: str, token_file: Path | None) -> "Access":
    """Access of a page; raises ConfigurationError before anything else is begun."""
    from eitskin.cli.page.access import Access

    return Access.of(host, token_file)
