"""The exported folder: read again by arro3 it has the recorded values; wrong input is refused in a sentence."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from arro3 import io

from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import tool_schemas
from dualbrain.errors import ConfigurationError, DualbrainError, UnknownNameError
from dualbrain.robots.loader import load_builtin_robot
from dualbrain.runtime.data_collection.lerobot import dataset_folder
from dualbrain.runtime.data_collection.lerobot.dataset_folder import DatasetFolder
from dualbrain.runtime.data_collection.lerobot.export import export_runs
from dualbrain.runtime.data_collection.lerobot.features import INDEX_FEATURES
from dualbrain.runtime.data_collection.lerobot.frames import Frames, sample_frames
from dualbrain.runtime.data_collection.lerobot.statistics import STATISTICS, aggregate_statistics, feature_statistics
from dualbrain.skills.registry import skill_registry
from tests.runtime.data_collection.lerobot.sample_runs import INSTRUCTION, PERIOD, sample_rows, sample_trace, write_run

INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def read_table(path):
    """Columns of a Parquet file as lists, and the metadata of its schema."""
    reader = io.read_parquet(str(path))
    metadata = dict(reader.schema.metadata)
    table = reader.read_all()
    return {name: table[name].to_pylist() for name in table.column_names}, metadata


def data_columns(out):
    """The columns of all data files in their order, as arrays."""
    parts = [read_table(path)[0] for path in sorted(out.glob("data/*/*.parquet"))]
    return {name: np.array([value for part in parts for value in part[name]]) for name in parts[0]}


@pytest.fixture
def runs(tmp_path):
    made = []
    for number, (ticks, instruction) in enumerate([(200, INSTRUCTION), (1000, "stack"), (400, INSTRUCTION)]):
        rows = sample_rows(ticks=ticks, seed=number)
        places = ("tray", f"shelf_{number}")
        made.append((write_run(tmp_path / f"run{number}", rows, instruction=instruction, places=places), rows))
    return made


def folders(runs):
    return [folder for folder, _ in runs]


def test_the_dataset_has_the_recorded_values(runs, tmp_path):
    episodes = export_runs(folders(runs), tmp_path / "out")
    columns, start = data_columns(tmp_path / "out"), 0
    for number, ((_, rows), episode) in enumerate(zip(runs, episodes, strict=True)):
        frames = sample_frames(sample_trace(rows), 30, action="velocity", period=PERIOD, path=Path("a"))
        part = {name: values[start : start + len(frames)] for name, values in columns.items()}
        wanted = {"observation.state": frames.q, "action": frames.action, "dualbrain.u_nom": frames.u_nom}
        wanted |= {"dualbrain.delta": frames.delta, "dualbrain.h_min": frames.h_min, "dualbrain.status": frames.status}
        wanted |= {"intervention": frames.intervention, "dualbrain.opening": frames.opening}
        for name, values in wanted.items():
            assert np.array_equal(part[name].astype(values.dtype), values), name
        steps = np.arange(len(frames))
        assert np.array_equal(part["timestamp"].astype(np.float32), (steps / 30).astype(np.float32))
        assert np.array_equal(part["frame_index"], steps)
        assert np.array_equal(part["index"], start + steps)
        assert set(part["episode_index"]) == {number}
        assert set(part["task_index"]) == {number % 2}
        assert (episode.frames, episode.interventions) == (len(frames), frames.intervention.sum())
        assert (episode.run, episode.outcome) == (f"run{number}", "succeeded")
        start += len(frames)
    assert start == len(columns["index"])
    assert frames.intervention.any()


def test_the_metadata_describe_the_tables(runs, tmp_path):
    out = tmp_path / "out"
    export_runs(folders(runs), out, fps=20)
    info = json.loads((out / "meta/info.json").read_text())
    columns = data_columns(out)
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 20, "panda")
    assert (info["total_episodes"], info["total_tasks"], info["splits"]) == (3, 2, {"train": "0:3"})
    assert info["total_frames"] == len(columns["index"])
    assert list(info["features"]) == list(columns)
    for name, feature in info["features"].items():
        width = columns[name].shape[1] if columns[name].ndim == 2 else 1
        assert feature["shape"] == [width], name
        assert feature["names"] is None or len(feature["names"]) == width
    assert info["features"]["intervention"] == {"dtype": "bool", "shape": [1], "names": None}
    assert info["features"]["action"]["names"][0] == "panda_joint1.vel"
    stored = io.read_parquet(str(out / info["data_path"].format(chunk_index=0, file_index=0))).schema
    types = {"float32": "Float32", "int64": "Int64", "bool": "Boolean"}
    for name, feature in info["features"].items():
        width = feature["shape"][0]
        kind = types[feature["dtype"]]
        expected = kind if width == 1 else f"FixedSizeList({width} x {kind})"
        assert expected in str(stored.field(name).type), name


def test_tasks_have_the_index_that_pandas_reads(runs, tmp_path):
    export_runs(folders(runs), tmp_path / "out")
    columns, metadata = read_table(tmp_path / "out/meta/tasks.parquet")
    assert columns == {"task_index": [0, 1], "task": [INSTRUCTION, "stack"]}
    assert json.loads(metadata[b"pandas"])["index_columns"] == ["task"]


def test_episodes_have_their_ranges_and_statistics(runs, tmp_path):
    out = tmp_path / "out"
    export_runs(folders(runs), out)
    rows, _ = read_table(out / "meta/episodes/chunk-000/file-000.parquet")
    columns = data_columns(out)
    assert rows["episode_index"] == [0, 1, 2]
    assert rows["tasks"] == [[INSTRUCTION], ["stack"], [INSTRUCTION]]
    assert rows["dataset_from_index"] == [0, *rows["dataset_to_index"][:-1]]
    dtypes = {"bool": bool, "float32": np.float32, "int64": np.int64}
    features = json.loads((out / "meta/info.json").read_text())["features"]
    episodes = []
    for number, (first, end) in enumerate(zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True)):
        assert rows["length"][number] == end - first
        own = {
            name: feature_statistics(values[first:end].astype(dtypes[features[name]["dtype"]]))
            for name, values in columns.items()
        }
        for name, values in own.items():
            for key in STATISTICS:
                assert rows[f"stats/{name}/{key}"][number] == values[key].tolist()
        episodes.append(own)
    whole = json.loads((out / "meta/stats.json").read_text())
    for name, values in aggregate_statistics(episodes).items():
        assert {key: value.tolist() for key, value in values.items()} == whole[name]


def test_the_tools_are_the_skills_with_the_names_of_all_scenes(runs, tmp_path):
    export_runs(folders(runs), tmp_path / "out")
    tools = json.loads((tmp_path / "out/meta/info.json").read_text())["tools"]
    registry = skill_registry(load_builtin_robot("panda"))
    assert [tool["function"]["name"] for tool in tools] == [skill.name for skill in registry.skills]
    place = next(tool["function"] for tool in tools if tool["function"]["name"] == "place")
    assert place["parameters"]["properties"]["destination"]["enum"] == ["tray", "shelf_0", "shelf_1", "shelf_2"]
    grasp = next(tool["function"] for tool in tools if tool["function"]["name"] == "grasp")
    assert "enum" not in grasp["parameters"]["properties"]["object"]  # no scene had an object
    assert tools == tool_schemas(registry, SceneNames((), ("tray", "shelf_0", "shelf_1", "shelf_2")))


def test_frames_are_divided_into_files_of_bounded_size(runs, tmp_path, monkeypatch):
    export_runs(folders(runs), tmp_path / "one")
    monkeypatch.setattr(dataset_folder, "MAX_FILE_BYTES", 3000)
    monkeypatch.setattr(dataset_folder, "CHUNK_FILES", 2)
    export_runs(folders(runs), tmp_path / "many")
    names = sorted(path.relative_to(tmp_path / "many/data").as_posix() for path in tmp_path.glob("many/data/*/*"))
    assert names == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    rows, _ = read_table(tmp_path / "many/meta/episodes/chunk-000/file-000.parquet")
    assert list(zip(rows["data/chunk_index"], rows["data/file_index"], strict=True)) == [(0, 0), (0, 1), (1, 0)]
    one, many = data_columns(tmp_path / "one"), data_columns(tmp_path / "many")
    assert all(np.array_equal(one[name], many[name]) for name in one)


@pytest.mark.parametrize("robot", ["base", "mobile_panda", "ur5e"])
def test_other_robots_have_their_names(tmp_path, robot):
    model = load_builtin_robot(robot)
    run = write_run(tmp_path / "run", sample_rows(robot), robot=robot)
    export_runs([run], tmp_path / "out")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert features["observation.state"]["shape"] == [model.nq]
    assert features["action"]["shape"] == [model.n]
    if model.is_mobile:
        assert features["observation.state"]["names"][:3] == ["x.pos", "y.pos", "theta.pos"]
        with pytest.raises(ConfigurationError, match=r"mobile base\. Leave out --action position"):
            export_runs([run], tmp_path / "other", action="position")


def test_a_vector_of_one_joint_is_a_scalar_column(tmp_path):
    vector, number = np.ones((5, 1), np.float32), np.ones(5, np.float32)
    frames = Frames(
        q=vector,
        action=vector,
        u_nom=vector,
        delta=number,
        h_min=number,
        status=np.ones(5, np.int64),
        intervention=np.ones(5, bool),
        opening=number,
    )
    features = {"action": {"dtype": "float32", "shape": [1], "names": ["joint.vel"]}} | INDEX_FEATURES
    dataset = DatasetFolder(tmp_path, features, 30, "one_joint")
    dataset.add_episode(frames, "turn")
    dataset.finish([])
    assert data_columns(tmp_path)["action"].shape == (5,)


def test_without_an_opening_in_every_frame_there_is_no_such_column(tmp_path):
    run = write_run(tmp_path / "run", sample_rows(opening=np.full(200, np.nan)))
    export_runs([run], tmp_path / "out")
    assert "dualbrain.opening" not in data_columns(tmp_path / "out")


def test_a_robot_that_is_not_packaged_is_read_from_its_recording(tmp_path):
    model = msgspec.structs.replace(load_builtin_robot("panda"), name="mine")
    run = write_run(tmp_path / "run", sample_rows(), about={"robot": "/etc/passwd", "body": model})
    export_runs([run], tmp_path / "out")
    assert json.loads((tmp_path / "out/meta/info.json").read_text())["robot_type"] == "mine"


@pytest.mark.parametrize("name", ["../body.json", "/etc/passwd", "panda.json", ""])
def test_a_name_in_a_recording_opens_no_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for file in ("panda.json", "body.json"):
        (tmp_path / file).write_bytes(msgspec.json.encode(load_builtin_robot("panda")))
    run = write_run(tmp_path / "run", sample_rows(), about={"robot": name})
    with pytest.raises(UnknownNameError, match="packaged robot"):
        export_runs([run], tmp_path / "out")


def refused(runs, out, match, **options):
    with pytest.raises(DualbrainError, match=match):
        export_runs(runs, out, **options)
    assert not list(out.parent.glob(f"*{out.name}*")), "no half dataset"


def test_wrong_runs_are_refused_with_the_remedy(tmp_path):
    good, out = write_run(tmp_path / "good", sample_rows()), tmp_path / "out"
    refused([tmp_path / "none"], out, "is no recorded run: there is no .*none. Name the folder of a run")
    (tmp_path / "empty").mkdir()
    refused([tmp_path / "empty"], out, r"there is no .*episode\.mcap\. Name the folder of a run")
    refused([good, good / "episode.mcap"], out, "is listed twice. Name it once.")
    refused([], out, "No run is named.")
    other = write_run(tmp_path / "other", sample_rows("fr3"), robot="fr3")
    refused([good, other], out, r"different robots: .*panda.*fr3.*\. Export each robot into a dataset of its own\.")
    silent = write_run(tmp_path / "silent", sample_rows(ticks=1)[:0])
    refused([silent], out, "has no tick: .* Leave this run out.")
    unnamed = write_run(tmp_path / "unnamed", sample_rows(), instruction=" ")
    refused([unnamed], out, "has no instruction, and LeRobot needs a task. Name one: --task")
    assert export_runs([unnamed], out, task="stack")[0].task == "stack"


def test_damaged_recordings_are_refused(tmp_path):
    run, out = write_run(tmp_path / "run", sample_rows(ticks=3000)), tmp_path / "out"
    recording = run / "episode.mcap"
    data = recording.read_bytes()
    for share in (0.2, 0.4, 0.6):  # behind the messages only the index is missing, which nothing needs
        recording.write_bytes(data[: int(share * len(data))])
        refused([run], out, "is incomplete: the recorder was ended .* Leave this run out, or record it again.")
    recording.write_bytes(b"x" * 100)
    refused([run], out, "is not an MCAP file")
    changed = bytearray(data)
    changed[len(data) // 2] ^= 0xFF
    recording.write_bytes(bytes(changed))
    refused([run], out, "is damaged")
    recording.write_bytes(data)
    (run / "episode.json").write_text("[")
    refused([run], out, r"episode\.json is no episode of dualbrain .* leave this run out\.")
    (run / "episode.json").unlink()
    assert export_runs([run], out)[0].outcome is None


def test_ticks_of_another_robot_are_refused(tmp_path):
    run = write_run(tmp_path / "run", sample_rows("base"), robot="base", about={"robot": "panda"})
    refused([run], tmp_path / "out", "is damaged: ticks of 2 joints for a robot of 7")


def test_a_used_folder_is_not_touched(tmp_path):
    run, out = write_run(tmp_path / "run", sample_rows()), tmp_path / "out"
    out.mkdir()
    export_runs([run], out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(ConfigurationError, match=r"is no empty folder\. Name a new folder with --out"):
        export_runs([run], out)
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="is no empty folder"):
        export_runs([run], tmp_path / "file")


def test_a_failed_export_leaves_nothing(tmp_path, monkeypatch):
    run, out = write_run(tmp_path / "run", sample_rows()), tmp_path / "out"

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dataset_folder, "write_episodes", full)
    refused([run], out, "No space left on device. .*Free some space.")
