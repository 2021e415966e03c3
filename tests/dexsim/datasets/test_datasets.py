"""Trajectories as a LeRobot dataset, and episodes for the live view: what is read back is what went in."""

import dataclasses
import io
import json

import numpy as np
import pytest
from PIL import Image

from dexsim.core.assets import asset_path
from dexsim.datasets.episodes import read_episodes, write_episodes
from dexsim.datasets.lerobot import FPS, Trajectory, write_lerobot
from dexsim.errors import DexsimError
from dexsim.render.snapshot import Snapshot

pyarrow = pytest.importorskip("pyarrow")


def trajectory(ticks, seed=0, period=0.03):
    rng = np.random.default_rng(seed)
    force = rng.uniform(0, 1, (ticks, 5, 120)) * (rng.random((ticks, 5, 120)) < 0.05)
    return Trajectory(
        time=period * np.arange(ticks),
        joint_position=rng.uniform(0, 1, (ticks, 12)).astype(np.float32),
        joint_torque=rng.uniform(-1, 1, (ticks, 12)).astype(np.float32),
        taxel_force=force.astype(np.float32),
        object_position=rng.uniform(0, 0.1, (ticks, 3)).astype(np.float32),
        object_quat=np.tile(np.float32([1, 0, 0, 0]), (ticks, 1)),
        command=np.linspace(0, 1, ticks, dtype=np.float32),
        target=rng.uniform(0, 1, (ticks, 12)).astype(np.float32),
    )


def test_another_rate_takes_the_nearest_tick():
    slow = trajectory(11, period=0.1).at_rate(4.0)
    np.testing.assert_allclose(slow.time, [0, 0.25, 0.5, 0.75, 1.0])
    # 0.25 s is between ticks 2 and 3, and 0.75 s between 7 and 8.
    picked = np.round(10 * slow.command).astype(int)
    assert picked[0] == 0 and picked[1] in (2, 3) and picked[2] == 5 and picked[3] in (7, 8) and picked[4] == 10
    fast = trajectory(3, period=0.1).at_rate(30.0)
    assert list(np.round(2 * fast.command).astype(int)) == [0, 0, 1, 1, 1, 2, 2]


@pytest.fixture
def dataset(hand, tmp_path):
    pytest.importorskip("pandas")
    written = [trajectory(100, 0), trajectory(61, 1)]
    return write_lerobot(tmp_path / "data", hand, "grasp", written), [t.at_rate(FPS) for t in written]


def test_frames_are_read_back_as_they_went_in(hand, dataset):
    folder, written = dataset
    table = pyarrow.parquet.read_table(folder / "data" / "chunk-000" / "file-000.parquet").to_pydict()
    state = np.array(table["observation.environment_state"], np.float32)
    pose = np.concatenate([np.concatenate([t.object_position, t.object_quat], -1) for t in written])
    np.testing.assert_array_equal(state, np.column_stack([pose, np.concatenate([t.command for t in written])]))
    joints = np.concatenate([t.joint_position for t in written])
    np.testing.assert_array_equal(np.array(table["observation.state"], np.float32), joints)
    np.testing.assert_array_equal(np.array(table["action"], np.float32), np.concatenate([t.target for t in written]))
    lengths = [len(t.time) for t in written]
    assert table["index"] == list(range(sum(lengths)))
    assert table["episode_index"] == [0] * lengths[0] + [1] * lengths[1]
    assert table["frame_index"] == [*range(lengths[0]), *range(lengths[1])]
    np.testing.assert_allclose(table["timestamp"], np.array(table["frame_index"]) / FPS, rtol=1e-6)
    # A taxel's vector points into the skin and is as long as its force.
    force = np.concatenate([t.taxel_force for t in written])
    for finger, name in enumerate(hand.finger_names):
        vectors = np.array(table[f"observation.tactile.{name}"])
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), force[:, finger], atol=1e-5)
        np.testing.assert_allclose(np.sum(vectors * -hand.taxel_normal[finger], -1), force[:, finger], atol=3e-5)


def test_the_description_fits_the_frames(hand, dataset):
    """What LeRobot 3.0 reads: version, paths, features with type and shape, episodes with their ranges, tasks."""
    import pandas

    folder, written = dataset
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == FPS and info["total_episodes"] == 2
    data = folder / info["data_path"].format(chunk_index=0, file_index=0)
    table = pyarrow.parquet.read_table(data)
    assert set(table.column_names) == set(info["features"]) and table.num_rows == info["total_frames"]
    for name, feature in info["features"].items():
        first = np.array(table[name][0].as_py())
        assert list(first.shape) == (feature["shape"] if feature["shape"] != [1] else []), name
        kind = table.schema.field(name).type
        while pyarrow.types.is_list(kind):
            kind = kind.value_type
        assert {"float": "float32", "int64": "int64"}[str(kind)] == feature["dtype"]
    assert info["features"]["observation.tactile.thumb"] == {
        "dtype": "float32", "shape": [120, 3], "names": ["Fx", "Fy", "Fz"]
    }  # fmt: skip
    episodes = pyarrow.parquet.read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    ends = np.cumsum([len(t.time) for t in written])
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(0, ends[0]), (ends[0], ends[1])]
    np.testing.assert_allclose(episodes[1]["stats/action/max"], written[1].target.max(0), rtol=1e-6)
    tasks = pandas.read_parquet(folder / "meta" / "tasks.parquet")
    assert list(tasks.index) == ["grasp"] and tasks.loc["grasp", "task_index"] == 0
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    both = np.concatenate([t.joint_position for t in written])
    np.testing.assert_allclose(stats["observation.state"]["mean"], both.mean(0), rtol=1e-5)
    np.testing.assert_allclose(stats["observation.state"]["q50"], np.median(both, 0), rtol=1e-5)
    places = json.loads((folder / "meta" / "tactile.json").read_text())["sensors"]
    np.testing.assert_allclose(places["observation.tactile.ring"]["position"], hand.taxel_position[3], atol=1e-6)


def test_a_dataset_that_fails_leaves_nothing(hand, tmp_path, monkeypatch):
    """And until then there is nothing by its name, which a kill would leave."""
    names = []

    def full(*_):
        names.extend(path.name for path in tmp_path.iterdir())
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dexsim.datasets.lerobot._tactile", full)
    with pytest.raises(OSError, match="No space left"):
        write_lerobot(tmp_path / "new", hand, "grasp", [trajectory(3)])
    assert not list(tmp_path.iterdir()) and len(names) == 1 and names[0].startswith(".new.")


def pictures(ticks):
    """Flat pictures [T], each a little brighter than the one before."""
    files = []
    for t in range(ticks):
        file = io.BytesIO()
        Image.fromarray(np.full((24, 32, 3), (t, 2 * t, 255), np.uint8)).save(file, "PNG")
        files.append(file.getvalue())
    return np.array(files, object)


@pytest.fixture
def filmed(hand, tmp_path):
    pytest.importorskip("pandas")
    written = dataclasses.replace(trajectory(31, period=1 / FPS), picture=pictures(31))
    return write_lerobot(tmp_path / "filmed", hand, "grasp", [written])


def test_pictures_are_read_back_with_their_shape_and_statistics(filmed):
    info, stats = (json.loads((filmed / "meta" / f"{name}.json").read_text()) for name in ("info", "stats"))
    name = "observation.images.scene"
    assert info["features"][name] == {"dtype": "image", "shape": [24, 32, 3], "names": ["height", "width", "channels"]}
    table = pyarrow.parquet.read_table(filmed / "data" / "chunk-000" / "file-000.parquet")
    for t, row in enumerate(table[name].to_pylist()):
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(row["bytes"])))[5, 7], (t, 2 * t, 255))
    np.testing.assert_allclose(stats[name]["max"], np.reshape([30, 60, 255], (3, 1, 1)) / 255)
    assert np.shape(stats[name]["mean"]) == (3, 1, 1) and stats[name]["count"] == [20]


def test_episodes_are_read_back_as_they_were_written(tmp_path):
    """In their format's precision, which those of a file have already."""
    written = read_episodes(asset_path("episodes") / "rotate.npz")
    write_episodes(tmp_path / "a.npz", written)
    found = read_episodes(tmp_path / "a.npz")
    expected = "rotate", "xhand_right", written.period, ("box",)
    assert (found.task, found.hand.name, found.period, found.kinds) == expected
    assert len(found.snapshots) == len(written.snapshots) > 1
    for now, before in zip(found.snapshots, written.snapshots, strict=True):
        for field in dataclasses.fields(Snapshot):
            np.testing.assert_array_equal(getattr(now, field.name), getattr(before, field.name))
    assert found.snapshots[1].turns[0] == 0 and np.all(np.diff(found.snapshots[1].seconds) > 0)
    (tmp_path / "b.npz").write_bytes(b"PK")
    np.savez(tmp_path / "c.npz", qpos=np.zeros(3))
    for name in ("b.npz", "c.npz"):
        with pytest.raises(DexsimError, match=f"{name}: no recorded episodes"):
            read_episodes(tmp_path / name)
