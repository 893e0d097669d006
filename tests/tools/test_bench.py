"""The benchmark's own arithmetic, and that its decoder rows compare whole, undamaged work."""

import gc
import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tools.bench import decoders, growth, processes, rows
from tools.bench.__main__ import BASELINE, BENCHMARKS, WHOLE_ROWS
from tools.bench.peers import PacketParser
from tools.bench.rows import TOLERANCE, Benchmark, Row, measure, shortfalls

ROW = Row("decode", 500.0, 100.0, "peer 1.0", 5.0, "frames/s", "higher", 0.1)
BASE = [{"name": "decode", "ratio": 5.0, "peer_name": "peer 1.0"}]


@pytest.fixture
def takes(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], Callable[[], None]]:
    """Maker of work that takes the given time [s] on a clock of its own."""
    clock = [0.0]
    monkeypatch.setattr(rows, "time", SimpleNamespace(process_time=lambda: clock[0]))
    monkeypatch.setattr(gc, "collect", lambda: 0)  # slow, and there is nothing to collect

    def make(seconds: float) -> Callable[[], None]:
        def run() -> None:
            clock[0] += seconds

        return run

    return make


def test_a_rate_is_compared_with_that_of_the_fastest_peer(
    takes: Callable[[float], Callable[[], None]],
) -> None:
    peers = {"slow 1.0": takes(0.8), "fast 2.0": takes(0.4)}
    row = measure("decode", Benchmark("frames/s", "higher", 100, takes(0.02), peers))
    assert (row.name, row.peer_name, row.unit, row.better) == ("decode", "fast 2.0", "frames/s", "higher")
    assert (row.ours, row.peer, row.ratio) == pytest.approx((5000, 250, 20))
    assert row.spread == pytest.approx(0)


def test_a_time_that_is_half_of_the_peers_is_twice_as_good(
    takes: Callable[[float], Callable[[], None]],
) -> None:
    row = measure("match", Benchmark("ms/scan", "lower", 0.1, takes(0.2), {"peer 1.0": takes(0.4)}))
    assert (row.ours, row.peer, row.ratio) == pytest.approx((2, 4, 2))


def test_a_figure_may_be_compared_with_what_is_needed(takes: Callable[[float], Callable[[], None]]) -> None:
    bench = Benchmark("frames/s", "higher", 100, takes(0.5))
    row = measure("decode", replace(bench, needed=("device rate", 50.0)))
    assert (row.ours, row.peer, row.peer_name, row.ratio) == (200, 50, "device rate", 4)
    alone = measure("decode", bench)
    assert (alone.ours, alone.peer, alone.peer_name, alone.ratio) == (200, None, None, None)


def test_one_slow_round_shows_in_the_spread_and_not_in_the_figure(
    takes: Callable[[float], Callable[[], None]],
) -> None:
    calls = [0]

    def run() -> None:
        calls[0] += 1
        takes(3.0 if calls[0] == 4 else 1.0)()

    row = measure("decode", Benchmark("frames/s", "higher", 10, run))
    assert (row.ours, row.spread) == (10, 2)


def test_a_ratio_falls_short_when_it_is_below_the_baseline_by_more_than_the_tolerance() -> None:
    least = (1 - TOLERANCE) * 5.0
    assert shortfalls([ROW, replace(ROW, ratio=least + 0.01)], BASE) == []
    (line,) = shortfalls([replace(ROW, ratio=least - 0.01)], BASE)
    assert line.startswith("decode: 3.49 x peer 1.0, must be at least 3.5")
    (line,) = shortfalls([replace(ROW, ratio=None)], BASE)
    assert "no peer" in line


def test_rows_that_the_baseline_does_not_name_are_not_compared() -> None:
    assert shortfalls([replace(ROW, name="other", ratio=None)], BASE) == []


def test_the_baseline_names_rows_that_there_are() -> None:
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    assert baseline
    assert {entry["name"] for entry in baseline} <= {*BENCHMARKS, *WHOLE_ROWS}
    assert all(entry["ratio"] > 0 and entry["better"] in ("higher", "lower") for entry in baseline)


def test_the_rows_that_others_read_are_there_and_in_the_baseline() -> None:
    stable = {
        *("linktrack_decode", "rplidar_express_decode", "rplidar_standard_decode", "scan_match"),
        *(f"pf_ibas_40_vs_pf_{n}_{what}" for n in (200, 1000) for what in ("time", "rmse")),
        *("smoother_batch_1000", "smoother_batch_10000"),
        *("smoother_fixed_lag_200_vs_batch", "smoother_fixed_lag_200_vs_incremental"),
        *("replay_real_time_factor", "live_cpu_share", "startup_help_s"),
    }
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    assert stable <= {*BENCHMARKS, *WHOLE_ROWS}
    assert stable - {entry["name"] for entry in baseline} == {"linktrack_decode"}


@pytest.mark.parametrize("name", decoders.BENCHMARKS)
def test_a_row_of_the_decoders_is_of_a_stream_that_is_decoded_whole(name: str) -> None:
    benchmark = decoders.BENCHMARKS[name]()  # raises when anything is lost, or a peer that is there disagrees
    assert benchmark.work > 1000
    assert benchmark.ours()


def test_a_peer_that_makes_other_points_of_the_bytes_is_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    parser = PacketParser(lambda packets: packets, lambda points: np.zeros((len(points), 2)))
    monkeypatch.setattr(decoders, "packet_parsers", {"standard": {"wrong 1.0": parser}}.get)
    with pytest.raises(decoders.DisagreementError, match=r"wrong 1\.0, standard scan: differs from ours by"):
        decoders.rplidar_standard_decode()


def test_the_growth_of_a_cost_is_the_exponent_of_its_power_law() -> None:
    sizes = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]
    # A constant share, as every call has one, does not hide how the rest grows.
    curve = growth.Curve("n", "us", sizes, [1.0 + 0.5 * size**2 for size in sizes])
    assert curve.exponent == pytest.approx(2.0, abs=0.05)
    assert growth.Curve("n", "us", sizes, [3.0 * size for size in sizes]).exponent == pytest.approx(1.0)


def test_growth_with_anchors_is_measured_on_as_many_ranges(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "_UPDATES", 3)
    monkeypatch.setattr(growth, "_ROUNDS", 1)
    curve = growth.anchors()
    assert curve.sizes == [4.0, 8.0, 16.0, 32.0]
    assert all(cost > 0.0 for cost in curve.costs)


def test_the_start_of_the_program_is_a_row_with_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_STARTS", 1)
    row = processes.startup_help_s()
    assert (row.unit, row.better, row.peer) == ("s", "lower", 0.5)
    assert row.ratio == pytest.approx(0.5 / row.ours)
    assert 0.01 < row.ours < 60.0
