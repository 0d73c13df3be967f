"""`eitskin dataset`: contents and verification of a dataset."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.markup import escape
from rich.table import Table

from eitskin.cli.options import FramesPath, Json, Output, Quiet, Seed, Verbose
from eitskin.errors import DataError

if TYPE_CHECKING:
    import numpy as np

    from eitskin.datasets.generation.verification import DamagedFile
    from eitskin.datasets.store.dataset import Dataset

app = typer.Typer(help="Show or verify a dataset.", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(help="The dataset's folder.")]
EXIT_DAMAGED = DataError.exit_code


@app.command("info")
def info(
    dataset: FramesPath,
    *,
    seed: Seed = 0,  # noqa: ARG001 - every command takes it
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show the contents of a dataset: frames, channels, states, angles, touches, origin."""
    from eitskin.datasets.store.folder import open_dataset

    output = Output(as_json, quiet, verbose)
    data = open_dataset(dataset)
    files = [dataset] if dataset.is_file() else list(dataset.glob("shard-*.h5"))
    megabytes = sum(path.stat().st_size for path in files) / 1e6
    found = {"dataset": str(dataset), "shards": len(files), "megabytes": round(megabytes, 3)}
    found |= _summary(data)
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in found.items():
        if value is not None:
            table.add_row(name.replace("_", " "), escape(_as_text(value)))
    output.result(found, table)


@app.command("verify")
def check(
    dataset: Folder,
    *,
    seed: Seed = 0,  # noqa: ARG001 - every command takes it
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Check every file of a dataset and list all damage; exit code 3 where there is any."""
    from eitskin.datasets.generation.verification import verify

    output = Output(as_json, quiet, verbose)
    with output.progress() as bar:
        task = bar.add_task("shards", total=None, rate="")
        verdict = verify(dataset, lambda done, total: bar.update(task, completed=done, total=total))
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


def _damage_table(damage: "tuple[DamagedFile, ...]") -> Table:
    table = Table("file", "what is wrong", box=box.SIMPLE)
    table.columns[0].no_wrap = True
    for each in damage:
        table.add_row(escape(each.file), escape(each.problem))
    return table


def frames_by_state(data: "Dataset") -> dict[str, int]:
    """Number of frames in each state, and of frames whose state is unknown."""
    import numpy as np

    from eitskin.datasets.store.state import State

    counts = {state.name.lower(): int(np.sum(data.state == state)) for state in State}
    return counts | {"unknown": len(data) - sum(counts.values())}


def _summary(data: "Dataset") -> dict[str, Any]:
    """Contents of the frames as plain data; None for what is unknown."""
    import numpy as np

    counts = frames_by_state(data)
    touches = np.bincount(data.touch_count, minlength=1)
    return {
        "frames": len(data),
        "channels": data.impedance.shape[1],
        "electrodes": data.protocol.n_electrodes if data.protocol else None,
        "frequency_hz": data.frequency,
        "source": data.source,
        "seed": data.seed if data.recipe else None,
        "specimens": len(data.reference),
        "episodes": len(np.unique(data.episode)),
        "states": {name: count for name, count in counts.items() if count},
        "touches_per_frame": {str(n): int(count) for n, count in enumerate(touches) if count},
        "bend_angle_deg": _range(data.bend_angle_deg),
        "touch_x_mm": _range(1e3 * data.touch_x),
        "touch_y_mm": _range(1e3 * data.touch_y),
        "force_n": _range(data.touch_force),
        "impedance_ohm": _range(np.abs(data.impedance)),
        "flagged_values": int(np.count_nonzero(data.status)),
    }


def _range(values: "np.ndarray[Any, Any]") -> dict[str, float] | None:
    """Least and greatest known value; None where none is known."""
    import numpy as np

    known = values[np.isfinite(values)]
    if not known.size:
        return None
    return {"from": float(f"{known.min():.4g}"), "to": float(f"{known.max():.4g}")}


def _as_text(value: Any) -> str:
    if not isinstance(value, Mapping):
        return str(value)
    if set(value) == {"from", "to"}:
        return f"{value['from']:g} to {value['to']:g}"
    return ", ".join(f"{name}: {count}" for name, count in value.items())
