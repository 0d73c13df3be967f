"""The pipeline that ships, live: the same frames, the same estimates."""

import dataclasses
import json

import numpy as np
import pytest
from command_line import run

from eitskin.frame import Frame
from eitskin.hardware import run_live

from live_fakes import FakeBoard


@pytest.mark.slow
def test_a_recording_replays_to_identical_lines(tmp_path):
    """Through the command, with lost frames, values that are none, and a restart."""
    scene = tmp_path / "script.toml"
    scene.write_text(
        "repeat = false\n[[steps]]\nframes = 4\n[steps.scene]\n"
        "[[steps]]\nframes = 3\n[steps.scene.bend]\nangle_deg = 20.0\n"
        "[[steps]]\nframes = 9\n[steps.scene]\n[[steps.scene.touches]]\nx = 0.05\ny = 0.02\n"
    )
    uri = f"virtual:?speed=max&scene={scene}&faults=lost_frame@5,inf_channel@8:4,reboot@12"

    def lines(*arguments):
        result = run("live", "reference.eitmodel", "--json", *arguments, code=0)
        found = [json.loads(line) for line in result.stdout.splitlines()]
        moment = ("wall_time", "latency_ms", "rate_hz", "dropped", "skipped", "reconnections")
        return [{k: v for k, v in line.items() if k not in moment} for line in found]

    folder = tmp_path / "run"
    live = lines("--board", uri, "--frames", "14", "--record", str(folder))
    assert lines("--board", f"replay:{folder}") == live
    assert {line["session"] for line in live} == {1, 2}
    assert live[-1]["lost"] == 1
    assert live[8]["bad_channels"] == {"0-5": "not finite"}
    assert {line["state"] for line in live} == {"idle", "bend", "touch"}


def test_one_value_of_the_wrong_sign_is_left_out_and_many_are_no_sensor_at_rest(pipeline):
    layout = pipeline.layout
    noisy = layout.reference * (1 + 2e-4 * np.random.default_rng(0).standard_normal(28))
    good = Frame(noisy, layout.protocol, frequency=layout.frequency)
    numbers = np.arange(28)
    for turned in (numbers == 5, numbers >= 0, numbers >= 13):
        values = np.where(turned, -noisy, noisy if turned[5] else np.nan)
        later = dataclasses.replace(good, impedance=values, number=1, time=0.3)
        pipeline.reset()
        first, second = run_live(FakeBoard([good, later]), pipeline)
        assert not first.estimate.problems
        if turned.sum() == 1:
            (told,) = second.estimate.problems
            assert "sign changed" in told
            assert layout.protocol.labels[5] in told
        else:
            assert second.estimate is None
            assert "changed their sign" in second.problem
