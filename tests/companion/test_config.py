"""Configuration: errors name the key, the value and the limit; defaults are documented as they are."""

import tomllib
from pathlib import Path

import pytest

from companion.config import Config, config_from_toml, default_toml, load_config
from companion.errors import UserError
from companion.pipeline import make_scan_odometry
from companion.shipped_files import params_dir
from estimators.lidar.ekf_slam import EkfSlam
from estimators.lidar.scan_matching import ScanMatcher
from tests.conftest import SITE

SITE_TEXT = SITE.read_text(encoding="utf-8")


def test_default_toml_is_what_the_code_says() -> None:
    assert (params_dir() / "default.toml").read_text(encoding="utf-8") == default_toml()


def test_defaults_plus_the_required_keys_make_a_configuration() -> None:
    required = (
        "[anchors]\n0 = [0, 0, 2]\n1 = [5, 0, 2]\n2 = [0, 5, 2]\n"
        '[sensor.uwb]\ndriver = "linktrack"\nport = "/dev/ttyUSB0"\n'
    )
    text = default_toml().replace("[start]", "[start]\nx = 0\ny = 0\nyaw_deg = 0") + required
    assert config_from_toml(text, "defaults").pipeline.estimator == "ekf"


def test_resolved_configuration_reads_back_the_same(config: Config) -> None:
    text = config.to_toml()
    assert config_from_toml(text, "again").to_toml() == text
    assert config_from_toml(text, "again") == config


def test_every_shipped_site_loads() -> None:
    sites = list((params_dir() / "sites").glob("*.toml"))
    assert sites
    for site in sites:
        load_config(site)


def mavlink(lines: str) -> tuple[str, str]:
    """A change of the site file: settings of `[mavlink]`."""
    return "[start]", f"[mavlink]\n{lines}\n[start]"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("height = 0.30", "hieght = 0.30"), "body.hieght: unknown key"),
        (("x = 1.5", "x = nan"), "start.x: Input should be a finite number, got nan"),
        (("x = 1.5\n", ""), "start: x is required and missing (or set known = false)"),
        (("sigma_xy = 0.05", "sigma_xy = -1"), "start.sigma_xy: Input should be greater than 0, got -1"),
        (("2.2]", '"high"]'), "anchors.0.2: Input should be a valid number"),
        (('driver = "rplidar"', 'driver = "velodyne"'), "there are: linktrack, rplidar"),
        (("?baud=256000", "?baud=fast"), "baud must be a number from 1200 to 4000000, got 'fast'"),
        (("[start]", "[estimator.kalman]\n[start]"), "estimator.kalman: unknown key"),
        (("[start]", '[pipeline]\nestimator = "ukf"\n[start]'), "unknown estimator 'ukf', there are: ekf"),
        (("[start]", "[estimator.ekf]\nrange_sigma = 0\n[start]"), "estimator.ekf.range_sigma"),
        (
            ("[sensor.uwb]", "[sensor.uwb.settings]\nlatency_ms = -3\n[sensor.uwb]"),
            "sensor.uwb.settings.latency_ms: Input should be greater than or equal to 0, got -3",
        ),
        (("2 = [7.85, 6.85, 2.3]\n3 = [7.85, 0.15, 1.9]\n", ""), "anchors: 2 anchors given"),
        (
            ("2 = [7.85, 6.85, 2.3]\n3 = [7.85, 0.15, 1.9]\n", "2 = [0.15, 9.0, 2.0]\n"),
            "anchors: all 3 anchors lie within 0.00 m of one line (at least 0.1 m is needed)",
        ),
        (("[site]", "[site"), "is not valid TOML"),
        (
            ("[start]", "[relocation]\nenabled = false\n[start]\nknown = false"),
            "relocation: enabled must be true",
        ),
        (mavlink("speed = true\nmessage = 'odometry'"), "mavlink: odometry carries the velocity already"),
        (mavlink("speed = true\nprofile = 'px4'"), "mavlink: PX4 reads no VISION_SPEED_ESTIMATE"),
        (mavlink("forward = true"), "mavlink: forward needs a second link"),
        (
            mavlink("url = 'udpin:0.0.0.0:14550'\nground_url = 'udpin:0.0.0.0:14550'"),
            "mavlink: url and ground_url are the same link, 'udpin:0.0.0.0:14550'",
        ),
        (mavlink("autopilot_id = 255"), "mavlink: autopilot_id 255 is one of ground_ids"),
        (mavlink("ground_ids = [0]"), "mavlink.ground_ids.0: Input should be greater than or equal to 1"),
        (mavlink("raw_ranges = true"), "mavlink: raw_ranges give anchors by latitude and longitude"),
    ],
)
def test_a_wrong_site_file_is_refused_in_one_line(change: tuple[str, str], said: str) -> None:
    assert change[0] in SITE_TEXT
    with pytest.raises(UserError) as caught:
        config_from_toml(SITE_TEXT.replace(*change), "site.toml")
    assert said in str(caught.value)
    assert str(caught.value).startswith("site.toml")
    assert "\n" not in str(caught.value)


def test_obstacles_need_a_lidar() -> None:
    assert load_config(SITE, ["mavlink.obstacles=true"]).mavlink.obstacles
    without = SITE_TEXT[: SITE_TEXT.index("[sensor.lidar]")]
    with pytest.raises(UserError, match="mavlink: obstacles come from a LiDAR"):
        config_from_toml(without, "site.toml", ["mavlink.obstacles=true"])


def test_a_start_that_is_unknown_needs_no_pose() -> None:
    config = load_config(SITE, ["start.known=false"])
    assert not config.setup().start.known
    a, b = SITE_TEXT.index("x = 1.5"), SITE_TEXT.index("sigma_xy")
    without = config_from_toml(SITE_TEXT[:a] + "known = false\n" + SITE_TEXT[b:], "site.toml")
    assert not without.setup().start.known
    assert config_from_toml(without.to_toml(), "again") == without


def test_set_changes_one_setting() -> None:
    changed = load_config(
        SITE, ["pipeline.rate=20", "sensor.uwb.port=/dev/null", "estimator.ekf.range_sigma=0.2"]
    )
    assert changed.pipeline.rate == 20.0
    assert changed.sensor["uwb"].port == "/dev/null"
    assert changed.estimator_config("ekf").model_dump()["range_sigma"] == 0.2


@pytest.mark.parametrize(
    "assignment", ["rate", "=3", "pipeline.rate.hz=3", "pipeline.rate=much", "no.such=1"]
)
def test_a_wrong_set_is_refused(assignment: str) -> None:
    with pytest.raises(UserError):
        load_config(SITE, ["pipeline.rate=20", assignment])


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot read .*nowhere\.toml: No such file"):
        load_config(tmp_path / "nowhere.toml")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="is not a text file"):
        load_config(binary)


def test_radians_and_metres_reach_the_estimators(config: Config) -> None:
    raw = tomllib.loads(SITE_TEXT)
    setup = config.setup()
    assert setup.anchors[2].tolist() == raw["anchors"]["2"]
    assert setup.start.sigma[2] == pytest.approx(raw["start"]["sigma_yaw_deg"] * 3.14159265 / 180)
    assert setup.height_to(setup.anchors[0]) == pytest.approx(2.2 - 0.30 - 0.20)


def test_the_front_end_is_chosen_by_name_with_its_own_table(config: Config) -> None:
    assert isinstance(make_scan_odometry(config), ScanMatcher)
    text = config.to_toml()
    chosen = config_from_toml(text, "x", ["pipeline.front_end=ekf_slam", "ekf_slam.max_features=7"])
    assert isinstance(make_scan_odometry(chosen), EkfSlam)
    with pytest.raises(UserError, match="unknown front end 'icp', there are: ekf_slam, scan_matcher"):
        config_from_toml(text, "x", ["pipeline.front_end=icp"])
