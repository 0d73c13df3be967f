"""The sections of a demo's report: what its stages left behind, in the order it is read in."""

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from eitskin.cli.demo import results as demo_results
from eitskin.cli.demo.folder import SETS
from eitskin.cli.demo.html import figures, filled, paragraph, section, table
from eitskin.cli.demo.parts import Kept
from eitskin.cli.demo.stages import STAGES

TITLE = "A skin that feels where it is touched and how far it is bent"

Parts = Mapping[str, Kept]
Document = Mapping[str, Any]


def content(parts: Parts, document: Document) -> Iterator[str]:
    """The sections; each says first what is seen."""
    yield _head(document)
    yield _sensor(parts, document)
    yield _sets(parts, document)
    yield _training(parts, document)
    yield demo_results.states_and_angle(parts, document)
    yield demo_results.touches(parts, document)
    yield demo_results.places(parts, document)
    yield demo_results.latency(parts, document)
    yield demo_results.live(parts, document)
    yield demo_results.real(parts)
    yield demo_results.paper(parts)
    yield _provenance(parts, document)


TILES = (
    (
        "Where it is touched",
        "{indentation.touches.1.mean_error_mm:.1f} <small>mm off on average</small>",
        "{indentation.touches.1.frames} touches of 10 N at 27 places, flat; with the pipeline "
        "that comes along {shipped_indentation.touches.1.mean_error_mm:.1f} mm; published 4.8 mm",
    ),
    (
        "What happens to it",
        "{test.states.accuracy.touch:.1%} <small>of touches recognised</small>",
        "idle {test.states.accuracy.idle:.1%}, bent {test.states.accuracy.bend:.1%}; published "
        "touch 99 %, idle over 97 %",
    ),
    (
        "How far it is bent",
        "{test.bend.rmse_deg:.2f}° <small>off (RMSE)</small>",
        "of bent frames without touch, from -20° to 50°; published 0.90°",
    ),
    (
        "How fast it feels",
        "{latency.trained here.whole frame.p50_ms:.1f} <small>ms per frame</small>",
        "p99 {latency.trained here.whole frame.p99_ms:.1f} ms, processing on one thread of this "
        "machine; published 303 ms",
    ),
)


def _head(document: Document) -> str:
    tiles = "".join(
        f'<div class="tile"><h3>{title}</h3><div class="large">{filled(large, document)}</div>'
        f"<p>{filled(small, document)}</p></div>"
        for title, large, small in TILES
    )
    links = {
        "sensor": "Sensor",
        "sets": "Training sets",
        "training": "Training",
        "angle": "States and angle",
        "touches": "Touch maps",
        "places": "Places",
        "latency": "Latency",
        "live": "Live",
        "real": "Real recordings",
        "paper": "The paper's table",
        "provenance": "Provenance",
    }
    nav = "".join(f'<a href="#{name}">{text}</a>' for name, text in links.items())
    intro = (
        "One command simulated a soft sheet with {sensor.electrodes} electrodes, bent and pressed "
        "it {sets.quick.frames:,} times, trained a perception pipeline on that, measured it on "
        "{sets.quick_test.frames} other frames and ran it live. Every number on this page is from "
        "this run, but those called published, which are of Chen et al., IEEE RA-L 2026, on a real "
        "sensor. This run's sensor is simulated, and training and test are of one specimen: the "
        "numbers say that the chain works, not how well it would do on a hand-cast gel."
    )
    made = "{provenance.machine}, {provenance.cores} cores; seed {provenance.seed}; "
    made += "{provenance.date}"
    return (
        f"<header><h1>{TITLE}</h1>{paragraph(filled(intro, document))}"
        f"{paragraph(filled(made, document), 'dim')}</header>\n"
        f'<div class="tiles">{tiles}</div>\n<nav>{nav}</nav>'
    )


def _sensor(parts: Parts, document: Document) -> str:
    text = (
        "A slab of hydrogel, {sensor.length_mm:.0f} x {sensor.width_mm:.0f} x "
        "{sensor.thickness_mm:.0f} mm, with {sensor.electrodes} electrodes on its rim. All it says "
        "are the {sensor.resistances} resistances between pairs of them, {sensor.smallest_ohm:.0f} "
        "to {sensor.largest_ohm:.0f} ohm while it lies flat and untouched."
    )
    bent = (
        "Bending and pressing change the shape of the gel and with it the resistances: the press "
        "at two places by {states.scenes.0.rms_percent:.2f} % (root mean square of all pairs), the "
        "bend by {states.scenes.1.rms_percent:.1f} %. Touches have to be found in what is left of "
        "the bend."
    )
    return section(
        "sensor",
        "The sensor, bent and pressed",
        paragraph(filled(text, document)),
        figures(parts["sensor"].part, "sensor"),
        paragraph(filled(bent, document)),
        figures(parts["states"].part, "scenes", "changes"),
    )


def _sets(parts: Parts, document: Document) -> str:
    cells = (
        ("frames", "{sets.%s.frames}"),
        ("idle", "{sets.%s.states.idle}"),
        ("touch", "{sets.%s.states.touch}"),
        ("bend", "{sets.%s.states.bend}"),
        ("touches", "{sets.%s.touches}"),
        (
            "angles, deg",
            "{sets.%s.smallest_angle_deg:.0f} to {sets.%s.largest_angle_deg:.0f}",
        ),
        ("mesh", "{sets.%s.resolution}"),
        ("seed", "{sets.%s.seed}"),
    )
    rows = [
        (name, *(filled(cell.replace("%s", name), document) for _, cell in cells)) for name in SETS
    ]
    text = (
        "The pipeline learns from one set and is measured on two others, whose frames come from a "
        "finer mesh and other seeds, so that it cannot do well by knowing the mesh. All have white "
        "noise {sets.quick.snr_db:.0f} dB below full scale."
    )
    return section(
        "sets",
        "Training and test frames",
        paragraph(filled(text, document)),
        table(("set", *(name for name, _ in cells)), rows, "What the sets hold.", as_html=True),
        figures(parts["sets"].part, "states", "places", "frames"),
    )


def _training(parts: Parts, document: Document) -> str:
    text = (
        "Two small convolutional networks and a regression were trained on {training.frames} of "
        "the frames in {training.seconds:.0f} s: one network tells the states apart, the other "
        "makes touch maps of reconstructed pictures."
    )
    return section(
        "training",
        "Training",
        paragraph(filled(text, document)),
        figures(parts["training"].part, "losses"),
    )


def _provenance(parts: Parts, document: Document) -> str:
    made = document["provenance"]
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    rows = [
        (
            stage.heading,
            filled(f"{{seconds.{stage.name}:.0f}}", document),
            escape(_spoken(parts[stage.name].date)),
            escape(_inputs(parts[stage.name].made_from)),
        )
        for stage in STAGES
    ]
    return section(
        "provenance",
        "Where these numbers come from",
        paragraph(f"<code>{escape(made['command'])}</code>"),
        paragraph(
            escape(
                f"{made['machine']}, {made['cores']} cores; Python {made['python']}, {versions}; "
                f"seed {made['seed']}; {_spoken(made['date'])} UTC"
            )
        ),
        table(
            ("stage", "s", "finished, UTC", "made from"),
            rows,
            "A stage that was finished before is kept while what it is made from stays the same.",
            as_html=True,
        ),
    )


def _inputs(made_from: Mapping[str, Any]) -> str:
    """Frames, weights and files by the beginnings of their SHA-256."""
    found: list[str] = []
    for kind in ("frames", "weights", "files"):
        value = made_from.get(kind, {})
        named = value if isinstance(value, dict) else {"": value}
        found += [" ".join((kind, name, digest[:8])) for name, digest in named.items()]
    return ", ".join(found).replace("  ", " ") or "the design"


def _spoken(date: str) -> str:
    """An ISO date with time, as people write it."""
    return date.replace("T", " ").removesuffix("+00:00")
