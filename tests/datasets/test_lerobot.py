"""Episodes in the LeRobot format, by its published layout of version 3.0."""

import json

import numpy as np
import pytest

from eitskin.datasets import export_dataset, open_dataset, save_dataset
from eitskin.datasets.export import lerobot
from eitskin.errors import DataError

from on_demand import OnDemand
from small_dataset import make

pd = OnDemand("pandas")

EPISODES, LENGTH, SINGLE = 24, 10, 5


def episodic():
    """24 episodes of ten frames of a sensor each, after five single frames."""
    count = SINGLE + EPISODES * LENGTH
    episode = np.concatenate([np.arange(SINGLE), SINGLE + np.repeat(np.arange(EPISODES), LENGTH)])
    return make(
        count,
        SINGLE + EPISODES,
        specimen=episode,
        episode=episode,
        time=0.25 * np.concatenate([np.zeros(SINGLE), np.tile(np.arange(LENGTH), EPISODES)]),
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets") / "episodes"
    save_dataset(episodic(), folder, frames_per_shard=23)  # episodes go on in the next shard
    return folder


@pytest.fixture(scope="module")
def out(saved, tmp_path_factory):
    """Folder of an export whose files hold a few episodes each."""
    made = tmp_path_factory.mktemp("out") / "lerobot"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot, "FILE_MEGABYTES", 0.03)
        patch.setattr(lerobot, "CHUNK_FILES", 2)
        export_dataset(saved, made, "lerobot")
    return made


@pytest.fixture(scope="module")
def info(out):
    return json.loads((out / "meta" / "info.json").read_text())


@pytest.fixture(scope="module")
def episodes(out):
    return pd.read_parquet(out / "meta" / "episodes")


@pytest.fixture(scope="module")
def frames(out):
    paths = sorted((out / "data").glob("*/*.parquet"))
    return pd.concat([pd.read_parquet(path) for path in paths], ignore_index=True)


@pytest.mark.slow
def test_files_are_as_the_layout_says_with_statistics_of_all_frames(out, info, episodes, frames):
    assert info["total_frames"] == len(frames) == EPISODES * LENGTH
    assert info["total_episodes"] == len(episodes) == EPISODES
    assert frames["index"].tolist() == list(range(len(frames)))
    for each in episodes.itertuples():
        mine = frames.iloc[each.dataset_from_index : each.dataset_to_index]
        assert set(mine["episode_index"]) == {each.episode_index}
        assert mine["frame_index"].tolist() == list(range(each.length))
    assert info["fps"] == pytest.approx(4.0)
    assert list(info["features"]) == list(frames.columns)
    for name, feature in info["features"].items():
        assert np.size(frames[name][0]) == feature["shape"][0], name
        assert np.asarray(frames[name][0]).dtype == feature["dtype"], name
    tasks = pd.read_parquet(out / "meta" / "tasks.parquet")
    assert (tasks.index.tolist(), tasks["task_index"].tolist()) == ([lerobot.TASK], [0])
    assert episodes["data/chunk_index"].max() > 0
    for each in episodes.to_dict("records"):
        path = info["data_path"].format(
            chunk_index=each["data/chunk_index"], file_index=each["data/file_index"]
        )
        held = pd.read_parquet(out / path, columns=["episode_index"])["episode_index"]
        assert (held == each["episode_index"]).sum() == each["length"]
    told = json.loads((out / "meta" / "stats.json").read_text())
    for name, each in told.items():
        values = np.stack(frames[name]).reshape(len(frames), -1).astype(float)
        np.testing.assert_allclose(each["mean"], values.mean(axis=0), rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(each["std"], values.std(axis=0), rtol=1e-9, atol=1e-9)
        assert each["max"] == values.max(axis=0).tolist()
    assert set(told) == {name for name in frames.columns if not name.startswith("label.")}


@pytest.mark.slow
def test_each_frame_is_the_datasets_own(saved, episodes, frames):
    data = open_dataset(saved)
    for each in episodes.itertuples():
        mine = frames[frames["episode_index"] == each.episode_index]
        rows = np.flatnonzero(data.episode == each.episode)
        true = data.select(rows)
        for part in ("real", "imag"):
            found = np.stack(mine[f"observation.impedance_{part}"])
            np.testing.assert_array_equal(found, getattr(true.impedance, part))
            found = np.stack(mine[f"observation.reference_{part}"])
            reference = true.reference[true.specimen]
            np.testing.assert_array_equal(found, getattr(reference, part))
        np.testing.assert_array_equal(mine["timestamp"], true.time.astype(np.float32))
        np.testing.assert_array_equal(mine["label.state"], true.state)
        np.testing.assert_array_equal(mine["label.bend_angle_deg"], true.bend_angle_deg)
        touches = np.stack(mine["label.touches"]).reshape(LENGTH, 4, 5)
        names = ("x", "y", "force", "radius", "depth")
        for place, name in enumerate(names):
            np.testing.assert_array_equal(touches[..., place], getattr(true, f"touch_{name}"))


def test_frames_without_episodes_or_times_are_refused(tmp_path):
    for name, changes, message in (
        ("single", {"episode": np.arange(12)}, "huggingface"),
        ("still", {"specimens": 1, "time": np.zeros(12)}, "times"),
    ):
        save_dataset(make(12, **changes), tmp_path / name)
        with pytest.raises(DataError, match=message):
            export_dataset(tmp_path / name, tmp_path / "out", "lerobot")
        assert not (tmp_path / "out").exists()


def test_another_sensor_begins_another_episode():
    data = make(20, 2, specimen=np.arange(20) // 5 % 2, episode=np.zeros(20))
    table = lerobot.Episodes(data, {0: "train", 1: "test"}).table
    assert table["length"].tolist() == [5, 5, 5, 5]
    assert table["split"].tolist() == ["train", "train", "test", "test"]
