"""`eitskin reconstruct SOURCE`: pictures of the conductivity change, without training."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from eitskin.cli.commands.live import PagePort, ShowPage
from eitskin.cli.commands.reconstruct_live import picture_live
from eitskin.cli.commands.reconstruct_output import (
    as_data,
    as_table,
    require_out,
    write_pictures,
)
from eitskin.cli.commands.reconstruct_sources import pictured_frames
from eitskin.cli.options import (
    Json,
    MeasuredPairs,
    Output,
    Quiet,
    Seed,
    SensorFile,
    Verbose,
    one_of,
)

if TYPE_CHECKING:
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.protocol import Protocol
    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.reconstruction.reconstructor import Difference, Method

Source = Annotated[
    str,
    typer.Argument(help="Dataset folder or shard, scene file (.toml), or board URI."),
]
MethodName = Annotated[
    str,
    typer.Option(
        "--method",
        help="back-projection, tikhonov, noser, laplace, total-variation, greit, or all.",
    ),
]
Rule = Annotated[
    str, typer.Option("--lambda", help="noise-figure:1, snr:100, gcv, or lambda:0.01.")
]
DifferenceName = Annotated[
    str | None,
    typer.Option(
        "--difference",
        help="relative (channel by channel) or absolute; chosen by the protocol when omitted.",
    ),
]
Chosen = Annotated[
    str | None,
    typer.Option("--frames", help="Frames of a dataset, as 0,5,10-12; of a board, how many."),
]
Reference = Annotated[
    str, typer.Option(help="Reference of a dataset's frames: untouched, flat, or a frame number.")
]
Averaged = Annotated[
    int, typer.Option(min=1, help="First frames of a board, untouched, that make its reference.")
]
Out = Annotated[
    Path | None, typer.Option(help="Picture (.png), or values with their positions (.npz, .csv).")
]


def command(
    source: Source,
    *,
    sensor: SensorFile = None,
    protocol: MeasuredPairs = None,
    method: MethodName = "greit",
    rule: Rule = "noise-figure:1",
    difference: DifferenceName = None,
    frames: Chosen = None,
    reference: Reference = "untouched",
    average: Averaged = 16,
    pixels: Annotated[int, typer.Option(help="Pixels of the bounding box, about.")] = 2250,
    resolution: Annotated[str, typer.Option(help="coarse, fast, standard or fine.")] = "fast",
    out: Out = None,
    page: ShowPage = False,
    page_port: PagePort = 8940,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Picture where the conductivity of any sensor has changed, without a trained pipeline."""
    import numpy as np

    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.reconstruction.reconstructor import Difference, Method, Reconstructor
    from eitskin.training.reconstruction.regularisation import Regularisation

    output = Output(as_json, quiet, verbose)
    names = list(get_args(Method)) if method == "all" else [one_of("--method", method, Method)]
    chosen_rule = Regularisation.named(rule)
    compared = None if difference is None else one_of("--difference", difference, Difference)
    detail = cast("Resolution", one_of("--resolution", resolution, Resolution))
    require_out(out)

    def maker(design: "SensorDesign", protocol: "Protocol", name: str) -> Reconstructor:
        return Reconstructor(
            design,
            protocol,
            cast("Method", name),
            chosen_rule,
            pixels,
            cast("Difference | None", compared),
            detail,
        )

    if page:
        picture_live(source, sensor, protocol, names, maker, page_port, seed, output)
        return
    taken = pictured_frames(
        source, sensor, protocol, frames, reference, average, detail, seed, output
    )
    impedance, before = np.array(taken.impedance), np.array(taken.reference)
    makers = [maker(taken.design, taken.protocol, name) for name in names]
    pictures = [each.images(each.data(impedance, before)) for each in makers]
    output.result(as_data(source, taken, makers, pictures, out), as_table(taken, makers, pictures))
    if out is not None:
        write_pictures(out, taken, makers, pictures)
        output.note(f"written: {out}")
