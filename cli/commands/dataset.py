"""`eitskin dataset`: contents, verification, compaction and combination of datasets."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.filesize import decimal
from rich.markup import escape
from rich.table import Table

from eitskin.cli.help import Command
from eitskin.cli.options import FramesPath, Output, with_output
from eitskin.errors import DataError

if TYPE_CHECKING:
    from eitskin.datasets.store.rewriting import DamagedFile

app = typer.Typer(help="Show, verify, compact or combine datasets.", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(help="Folder of the dataset.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes that read the shards.")]
EXIT_DAMAGED = DataError.exit_code


@app.command("info", cls=Command)
@with_output
def info(
    dataset: FramesPath,
    *,
    output: Output,
) -> None:
    """Show the contents of a dataset: frames, channels, states, angles, touches, origin."""
    from eitskin.datasets.store.folder import read_shards
    from eitskin.datasets.store.manifest import read_manifest
    from eitskin.datasets.store.summary import DatasetSummary

    summary = DatasetSummary()
    with output.counting("shards") as show:
        for part in read_shards(dataset, show):
            summary.add(part)
    files = [dataset] if dataset.is_file() else list(dataset.glob("shard-*.h5"))
    megabytes = sum(path.stat().st_size for path in files) / 1e6
    result = {"dataset": str(dataset), "shards": len(files), "megabytes": round(megabytes, 3)}
    result |= summary.contents()
    if not dataset.is_file():
        names = read_manifest(dataset).names
        result |= {
            "specimen_names": names.specimens or None,
            "session_names": names.sessions or None,
        }
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in result.items():
        if value is not None:
            table.add_row(name.replace("_", " "), escape(_as_text(value)))
    output.result(result, table)


@app.command("verify", cls=Command)
@with_output
def check(
    dataset: Folder,
    *,
    workers: Workers = 2,
    output: Output,
) -> None:
    """Check every file of a dataset and list all damage; exit code 3 where there is any."""
    from eitskin.datasets.store.rewriting import verify

    with output.counting("shards") as show:
        verdict = verify(dataset, show, workers)
    output.result(
        {
            "dataset": str(dataset),
            "sound": not verdict.damage,
            "shards": verdict.shards,
            "frames": verdict.frames,
            "damage": [{"file": each.file, "problem": each.problem} for each in verdict.damage],
        },
        _damage_table(verdict.damage)
        if verdict.damage
        else f"{verdict.frames} frames in {verdict.shards} shards, all sound",
    )
    if verdict.damage:
        output.note(f"{verdict.frames} frames in {verdict.shards} shards are sound")
        raise typer.Exit(EXIT_DAMAGED)


@app.command("compact", cls=Command)
@with_output
def compaction(
    dataset: Folder,
    *,
    out: Annotated[Path, typer.Option(help="Folder to write to; new or empty.")],
    frames_per_shard: Annotated[
        int, typer.Option(min=0, help="Frames in a file; 0 keeps the files as they are cut.")
    ] = 65536,
    workers: Workers = 2,
    output: Output,
) -> None:
    """Write a dataset again in few large files, in the newest version of the format."""
    from eitskin.datasets.store.rewriting import compact

    with output.counting("shards") as show:
        manifest = compact(dataset, out, frames_per_shard or None, show, workers)
    size = sum((out / entry.name).stat().st_size for entry in manifest.shards)
    result = {
        "out": str(out),
        "frames": manifest.frames,
        "shards": len(manifest.shards),
        "megabytes": round(size / 1e6, 3),
        "format_version": manifest.format_version,
    }
    output.result(
        result,
        f"{manifest.frames} frames in {len(manifest.shards)} shards in {out}, {decimal(size)}",
    )


@app.command("combine", cls=Command)
@with_output
def combination(
    datasets: Annotated[list[Path], typer.Argument(help="Folders of two or more datasets.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder to write to; new or empty.")],
    magnitudes: Annotated[
        bool, typer.Option(help="Combine magnitudes, where some recordings have no sign.")
    ] = False,
    output: Output,
) -> None:
    """Write the frames of different datasets, such as own presses and simulated ones, as one.

    They must share protocol, sensor, frequency and kind of values; differences are listed.
    """
    from eitskin.datasets.store.rewriting import combine

    with output.counting("shards") as show:
        manifest = combine(datasets, out, magnitudes, show)
    output.result(
        {"out": str(out), "frames": manifest.frames, "source": manifest.source},
        f"{manifest.frames} frames of {len(datasets)} datasets in {out}",
    )


def _damage_table(damage: "tuple[DamagedFile, ...]") -> Table:
    table = Table("file", "what is wrong", box=box.SIMPLE)
    table.columns[0].no_wrap = True
    table.columns[1].overflow = "fold"  # hashes are to be compared
    for each in damage:
        table.add_row(escape(each.file), escape(each.problem))
    return table


def _as_text(value: Any) -> str:
    if not isinstance(value, Mapping):
        return str(value)
    if set(value) == {"from", "to"}:
        return f"{value['from']:g} to {value['to']:g}"
    return ", ".join(f"{name}: {count}" for name, count in value.items())
