"""Recordings of others through our own drivers, and measurements as text there and back."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.tools import file_interface
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from companion.config import load_config
from companion.errors import UserError
from companion.importers.sources import import_log
from companion.importers.tables import nanoseconds
from companion.importers.text_folder import write_folder
from companion.log import Log, RawChunk, Truth
from companion.pipeline import make_sensors
from companion.replay import config_of, replay
from estimators.messages import ImuSample, Measurement, RangeFrame, Scan
from tests.companion.test_evaluation import companion
from tests.conftest import SITE

STAMP_NS = 1_510_918_289_965_888_123


def measured(path: Path) -> list[Measurement]:
    log = Log(path)
    sensors = make_sensors(config_of(log, []))
    return [m for r in log if isinstance(r, RawChunk) for m in sensors[r.source].feed(r.data, r.stamp_ns)]


def scans_of(path: Path) -> list[Scan]:
    return [m for m in measured(path) if isinstance(m, Scan)]


def ranges_of(path: Path) -> list[RangeFrame]:
    return [m for m in measured(path) if isinstance(m, RangeFrame)]


def truths_of(path: Path) -> list[Truth]:
    return [r for r in Log(path) if isinstance(r, Truth)]


def test_a_log_as_text_and_back_holds_the_same_measurements(short_log: Path, tmp_path: Path) -> None:
    log = Log(short_log)
    config = config_of(log, [])
    written = write_folder(log, config, tmp_path / "text")
    assert [path.name for path in written] == ["ranges.csv", "scans.csv", "imu.csv", "truth.tum"]
    import_log(tmp_path / "text", tmp_path / "back.mcap", SITE)
    before, after = measured(short_log), measured(tmp_path / "back.mcap")
    for kind in (RangeFrame, ImuSample):
        pairs = list(zip(of(before, kind), of(after, kind), strict=True))
        assert len(pairs) > 200
        for old, new in pairs:
            # The module's clock counts milliseconds.
            assert new.stamp_ns == pytest.approx(old.stamp_ns, abs=1_100_000)
            if isinstance(old, RangeFrame) and isinstance(new, RangeFrame):
                assert new.anchor_ids.tolist() == old.anchor_ids.tolist()
                assert new.ranges == pytest.approx(old.ranges, abs=5e-4)
                assert new.rx_power == pytest.approx(old.rx_power, abs=0.5)
            if isinstance(old, ImuSample) and isinstance(new, ImuSample):
                assert new.gyro == pytest.approx(old.gyro, abs=1e-6)
                assert new.accel == pytest.approx(old.accel, abs=1e-5)
    for one, other in zip(of(before, Scan), of(after, Scan), strict=False):
        assert isinstance(one, Scan)
        assert isinstance(other, Scan)
        assert other.ranges == pytest.approx(one.ranges, abs=2e-4)
    assert [t.stamp_ns for t in truths_of(tmp_path / "back.mcap")] == [
        t.stamp_ns for t in truths_of(short_log)
    ]
    accuracy = replay(Log(tmp_path / "back.mcap"), config, ["ekf"]).accuracy("ekf")
    assert accuracy is not None
    assert accuracy.rmse < 0.05


def of(measurements: Sequence[Measurement], kind: type) -> list[Measurement]:
    return [m for m in measurements if isinstance(m, kind)]


def test_evo_reads_the_trajectory_that_is_written(short_log: Path, tmp_path: Path) -> None:
    log = Log(short_log)
    write_folder(log, config_of(log, []), tmp_path)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "truth.tum")
    ours = np.array([truth.pose for truth in truths_of(short_log)])
    assert theirs.positions_xyz[:, :2] == pytest.approx(ours[:, :2], abs=1e-8)
    yaw = 2.0 * np.arctan2(theirs.orientations_quat_wxyz[:, 3], theirs.orientations_quat_wxyz[:, 0])
    assert np.cos(yaw - ours[:, 2]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1510918289.965888123", STAMP_NS),
        ("0.127943992614746", 127_943_992),
        ("12", 12_000_000_000),
        ("-1.5", -1_500_000_000),
        ("1.5e3", 1_500_000_000_000),
    ],
)
def test_times_keep_their_nanoseconds(text: str, expected: int) -> None:
    assert nanoseconds(text) == expected


TAIL = "1.7 2.6 0.6 0 0 0 0 0 1000.75 host 0.8"
RANGES = " ".join(f"{2.0 + 0.01 * i:.2f}" for i in range(180))
CARMEN = f"""# a comment
PARAM robot_front_laser_max 81.9
FLASER 180 {RANGES} 1.5 2.5 0.5 1.4 2.4 0.4 1000.25 host 0.3
ODOM 1.4 2.4 0.4 0 0 0 1000.3 host 0.4
FLASER 180 81.91 {RANGES.partition(" ")[2]} 1.6 2.5 0.5 1.5 2.4 0.4 1000.50 host 0.6
ROBOTLASER1 0 -1.0 2.0 0.02 20.0 0.01 0 100 {" ".join(["3.5"] * 99)} 25.0 2 7 7 1.7 2.6 0.6 {TAIL}
"""


def test_a_carmen_log_gives_scans_and_the_poses_of_the_laser(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(CARMEN)
    import_log(tmp_path / "a.log", tmp_path / "a.mcap", SITE)
    first, second, third = scans_of(tmp_path / "a.mcap")
    assert [scan.stamp_ns for scan in (first, second, third)] == pytest.approx(
        [1_000_250_000_000, 1_000_500_000_000, 1_000_750_000_000], abs=100_000
    )
    assert first.angles == pytest.approx(np.deg2rad(np.arange(-90.0, 90.0)), abs=1e-4)
    assert first.ranges == pytest.approx(2.0 + 0.01 * np.arange(180), abs=2e-4)
    assert second.ranges[:2] == pytest.approx([0.0, 2.01], abs=2e-4)
    assert third.angles == pytest.approx(-1.0 + 0.02 * np.arange(100), abs=1e-4)
    assert third.ranges[-2:] == pytest.approx([3.5, 0.0])
    poses = [truth.pose.tolist() for truth in truths_of(tmp_path / "a.mcap")]
    assert poses == [[1.5, 2.5, 0.5], [1.6, 2.5, 0.5], [1.7, 2.6, 0.6]]


@pytest.mark.parametrize("version", [1, 2])
def test_a_ros_bag_gives_scans_ranges_inertial_samples_and_a_reference(tmp_path: Path, version: int) -> None:
    bag = write_bag(tmp_path, version)
    import_log(bag, tmp_path / "a.mcap", SITE, truth="/odom")
    scans = scans_of(tmp_path / "a.mcap")
    assert len(scans) == 5
    assert scans[0].stamp_ns == pytest.approx(STAMP_NS, abs=1000)
    assert scans[0].angles == pytest.approx(-1.0 + 0.02 * np.arange(100), abs=1e-4)
    expected = np.where(np.arange(100) == 3, 0.0, 4.0)
    assert scans[0].ranges == pytest.approx(expected)
    ranges = ranges_of(tmp_path / "a.mcap")
    assert [(r.anchor_ids.tolist(), r.ranges.tolist()) for r in ranges] == [([2], [3.25])] * 5
    (sample, *others) = of(measured(tmp_path / "a.mcap"), ImuSample)
    assert isinstance(sample, ImuSample)
    assert len(others) == 4
    assert sample.gyro == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)
    assert sample.accel == pytest.approx([1.0, 2.0, 9.0], abs=1e-6)
    poses = np.array([truth.pose for truth in truths_of(tmp_path / "a.mcap")])
    assert poses == pytest.approx(np.array([[k, 2.0, np.pi / 2] for k in range(5)]), abs=1e-9)


def write_bag(folder: Path, version: int) -> Path:
    """Five messages of each kind, 0.1 s apart; the third beam of every scan is out of reach."""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    types: Any = store.types

    def stamp(k: int) -> Any:
        at_ns = STAMP_NS + k * 100_000_000
        time = types["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        head = {"seq": k} if version == 1 else {}
        return types["std_msgs/msg/Header"](stamp=time, frame_id="anchor_2", **head)

    def vector(x: float, y: float, z: float) -> Any:
        return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    beams = np.full(100, 4.0, np.float32)
    beams[3] = 50.0
    quaternion = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sqrt(0.5), w=np.sqrt(0.5))
    nine, many = np.zeros(9), np.zeros(36)
    messages: list[tuple[str, Callable[[int], Any]]] = [
        (
            "/scan",
            lambda k: types["sensor_msgs/msg/LaserScan"](
                stamp(k), -1.0, 1.0, 0.02, 1e-4, 0.1, 0.1, 30.0, beams, np.zeros(0, np.float32)
            ),
        ),
        (
            "/imu",
            lambda k: types["sensor_msgs/msg/Imu"](
                stamp(k), quaternion, nine, vector(0.1, 0.2, 0.3), nine, vector(1.0, 2.0, 9.0), nine
            ),
        ),
        ("/uwb", lambda k: types["sensor_msgs/msg/Range"](stamp(k), 0, 0.1, 0.1, 50.0, 3.25)),
        (
            "/odom",
            lambda k: types["nav_msgs/msg/Odometry"](
                stamp(k),
                "base",
                types["geometry_msgs/msg/PoseWithCovariance"](
                    types["geometry_msgs/msg/Pose"](
                        types["geometry_msgs/msg/Point"](float(k), 2.0, 0.0), quaternion
                    ),
                    many,
                ),
                types["geometry_msgs/msg/TwistWithCovariance"](
                    types["geometry_msgs/msg/Twist"](vector(0, 0, 0), vector(0, 0, 0)), many
                ),
            ),
        ),
    ]
    path = folder / ("a.bag" if version == 1 else "bag")
    writer = Writer1(path) if version == 1 else Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        for topic, make in messages:
            kind = make(0).__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            for k in range(5):
                serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
                writer.write(connection, STAMP_NS + k * 100_000_000, serialize(make(k), kind))
    return path


def test_a_topic_that_is_not_there_is_named(tmp_path: Path) -> None:
    bag = write_bag(tmp_path, 1)
    with pytest.raises(UserError, match=r"--truth /pose: no such topic, there are: /.*odom"):
        import_log(bag, tmp_path / "a.mcap", SITE, truth="/pose")
    with pytest.raises(UserError, match=r"--truth /scan: holds LaserScan, must be Odometry or PoseStamped"):
        import_log(bag, tmp_path / "a.mcap", SITE, truth="/scan")


def test_the_labyrinth_is_known_by_its_files(tmp_path: Path) -> None:
    folder = tmp_path / "any name"
    folder.mkdir()
    (folder / "Indoor_UWB_Input.txt").write_text(
        "range2 0.1279 2.955 0.01 -0.02 -0.01 105 0 \nodom2diff 0.2 0 0 0 1 1 1 1\n"
        "range2 0.2559 1.605 0.01 -0.02 2.365 107 0 \n"
    )
    (folder / "Indoor_UWB_GT.txt").write_text("point2 0.1279 1.652 2.219 0 0 0 0 \n")
    assert import_log(folder, tmp_path / "a.mcap") == 2
    assert [(r.anchor_ids.tolist(), r.ranges.tolist()) for r in ranges_of(tmp_path / "a.mcap")] == [
        ([105], [2.955]),
        ([107], [1.605]),
    ]
    (truth,) = truths_of(tmp_path / "a.mcap")
    assert truth.pose.tolist() == pytest.approx([1.652, 2.219, np.nan], nan_ok=True)
    assert truth.stamp_ns == 127_900_000


def test_a_recording_of_the_trolley_gives_ranges_and_place_of_one_tag(tmp_path: Path) -> None:
    (tmp_path / "UWB_dynamic_exp_fast.csv").write_text(
        "2022-08-15 9:42:24.766," + ",".join(f"{i}.5" if i != 3 else "NaN" for i in range(24)) + "\n"
    )
    data = Path(__file__).parent.parent / "data" / "lias_planar" / "motion_capture.csv"
    head = "\n".join(data.read_text().splitlines()[:3])
    (tmp_path / "motion_capture_dynamic_exp_fast.csv").write_text(head + "\n")
    import_log(tmp_path, tmp_path / "a.mcap")
    (frame,) = ranges_of(tmp_path / "a.mcap")
    assert frame.anchor_ids.tolist() == [0, 2, 3, 4, 5, 6, 7]
    assert frame.ranges.tolist() == [3 * i + 0.5 for i in (0, 2, 3, 4, 5, 6, 7)]
    # The trolley's centre is 0.16 m from the tag.
    row = [float(cell) for cell in head.splitlines()[1].split(",")[1:3]]
    assert np.hypot(*(truths_of(tmp_path / "a.mcap")[0].pose[:2] - row)) == pytest.approx(0.158, abs=5e-4)


def test_the_robot_with_a_laser_is_evaluated_by_one_command(tmp_path: Path) -> None:
    """Ten seconds in a square room, standing: what is estimated is the pose of the reference."""
    folder = tmp_path / "made up"
    folder.mkdir()
    angles = -2.3562 + 0.005817 * np.arange(811)
    walls = 3.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    rows = ["t_header,t_rec," + ",".join(f"r{i}" for i in range(811))]
    rows += [
        f"{100 + k / 15:.6f},0," + ",".join(f"{r:.4f}" for r in walls + 0.002 * np.sin(7 * angles + k))
        for k in range(150)
    ]
    (folder / "x_scan.csv").write_text("\n".join(rows) + "\n")
    biased = {177: 3.24 + 0.611, 178: 1.70 - 0.043, 180: 1.20 - 0.607}
    rows = ["t_header,t_rec,anchor_id,range_m", "100.1,0,177,0.0"]
    rows += [
        f"{100 + k / 18:.6f},0,{(177, 178, 180)[k % 3]},{biased[(177, 178, 180)[k % 3]]}" for k in range(170)
    ]
    (folder / "x_uwb.csv").write_text("\n".join(rows) + "\n")
    (folder / "x_ref_scanmatch.csv").write_text("# head\n" + "".join(f"{99 + k},0,0,0\n" for k in range(13)))
    done = companion(folder, "--estimators", "ekf", "--workers", "1", "--json", "f.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "made up: one trial" in done.stdout
    figures = json.loads((tmp_path / "f.json").read_text())["estimators"]["ekf"]
    assert figures["rmse_m"] < 0.1
    assert figures["yaw_rmse_deg"] < 2.0


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.xyz", "", r"a\.xyz: neither a data set that is known"),
        ("a.log", "FLASER 180 1 2 3\n", r"a\.log, line 1: FLASER is not complete"),
        ("a.log", "FLASER x\n", r"a\.log, line 1: FLASER is not complete: invalid literal"),
        ("a.log", "", r"the recording holds no range, scan or inertial sample"),
        ("a.bag", "rubbish", r"cannot read the bag .*a\.bag"),
    ],
)
def test_what_cannot_be_read_is_said(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=said):
        import_log(tmp_path / name, tmp_path / "out.mcap", SITE)


def test_a_site_is_not_asked_for_before_the_recording_is_one(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot read .*gone\.log: No such file or directory"):
        import_log(tmp_path / "gone.log", tmp_path / "out.mcap")
    with pytest.raises(UserError, match="neither a data set that is known"):
        import_log(tmp_path, tmp_path / "out.mcap")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("head\n1,1,0,2.0\n", r"ranges\.csv, line 2: 4 columns, 6 are needed"),
        ("head\n1,1,0,far,,\n", r"ranges\.csv: could not convert string to float: 'far'"),
        ("head\n0.5,1,0,2.0,,\n", r"ranges\.csv: a stamp is no whole number of nanoseconds"),
    ],
)
def test_a_wrong_line_of_text_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "ranges.csv").write_text(text)
    with pytest.raises(UserError, match=said):
        import_log(tmp_path, tmp_path / "out.mcap", SITE)


def test_a_recording_needs_a_site_with_its_sensors(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(CARMEN)
    with pytest.raises(UserError, match="give --site FILE"):
        import_log(tmp_path / "a.log", tmp_path / "a.mcap")
    only_uwb = tmp_path / "site.toml"
    text = SITE.read_text(encoding="utf-8")
    only_uwb.write_text(text[: text.index("[sensor.lidar]")], encoding="utf-8")
    load_config(only_uwb)
    with pytest.raises(UserError, match="no sensor with driver 'rplidar'"):
        import_log(tmp_path / "a.log", tmp_path / "a.mcap", only_uwb)
