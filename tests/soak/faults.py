"""Walks with random faults of both sensors, an hour of them, and what reaches the autopilot meanwhile.

    python -m tests.soak.faults --minutes 60

Everything runs in memory in simulated time: emulated devices, drivers, estimator, health, MAVLink. Each walk
has its own faults: noise on the lines, stalls, silence, pulled plugs, a LiDAR that stops itself. Every pose
on the wire must be finite with positive variances, no pose may leave while health is bad, and whatever jumps
must be counted. Exit code 1 when something is not so.
"""

import argparse
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2
from rich.console import Console

from companion.log import RawChunk
from companion.mavlink.link import NAME
from companion.pipeline import Tick
from companion.sim.autopilot import ned_pose
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS
from tests.soak.onboard import BASE, Onboard, scenario_text

KINDS = ("garbage", "truncation", "bit_flips", "stall", "silence", "disconnect")
PROTECTION_STOP = "protection_stop"
MEAN_PAUSE = 12.0
"""From one fault to the next of the same sensor, on average [s]."""
MEAN_FAULT = 3.0
"""[s]"""
LONGEST_WALK = 100.0
"""[s]"""
STOP_WITHIN_NS = 300_000_000
"""Longest time from the loss of health to the last pose."""


@dataclass
class Outcome:
    """What a soak run found.

    Attributes:
        minutes: of simulated time.
        poses: on the wire.
        losses: how often health was lost while poses were sent.
        slowest_stop: longest time from such a loss to the last pose [s].
        resets: how often the reset counter grew.
        states: ticks in each state of health.
        faults: what is wrong, a line each; empty when all is well.
    """

    minutes: float = 0.0
    poses: int = 0
    losses: int = 0
    slowest_stop: float = 0.0
    resets: int = 0
    states: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)


class Listener:
    """The autopilot's side: judges every pose against the one before and against health.

    Args:
        outcome: gets what is found.
    """

    def __init__(self, outcome: Outcome) -> None:
        self._outcome = outcome
        self._parser = mavlink2.MAVLink(None)
        self._last: mavlink2.MAVLink_message | None = None
        self._lost_ns: int | None = None
        self._sends = False

    def tick(self, tick: Tick, data: bytes, now_ns: int) -> None:
        """Take what was sent at one tick."""
        outcome = self._outcome
        outcome.states[tick.health.state] += 1
        if tick.health.sends:
            self._lost_ns = None
        elif self._lost_ns is None:
            self._lost_ns = now_ns
            outcome.losses += self._sends
        self._sends = tick.health.sends
        for message in self._parser.parse_buffer(data) or []:
            if message.get_type() == "VISION_POSITION_ESTIMATE":
                self._judge(message, now_ns)

    def _judge(self, message: mavlink2.MAVLink_message, now_ns: int) -> None:
        outcome, last = self._outcome, self._last
        outcome.poses += 1
        pose = ned_pose(message)
        values = np.concatenate([pose.position, pose.roll_pitch_yaw, pose.cov.ravel()])
        if not np.isfinite(values).all():
            outcome.faults.append(f"not finite at {now_ns}")
        elif np.diag(pose.cov).min() <= 0.0 or np.linalg.eigvalsh(pose.cov)[0] <= 0.0:
            outcome.faults.append(f"covariance not positive at {now_ns}")
        if self._lost_ns is not None:
            outcome.slowest_stop = max(outcome.slowest_stop, (now_ns - self._lost_ns) * 1e-9)
            if now_ns - self._lost_ns > STOP_WITHIN_NS:
                outcome.faults.append(f"a pose at {now_ns}, health lost at {self._lost_ns}")
        if last is not None:
            seconds = (message.usec - last.usec) * 1e-6
            if seconds < 0.02:
                outcome.faults.append(f"stamps {seconds:.3f} s apart at {now_ns}")
            far = float(np.hypot(message.x - last.x, message.y - last.y))
            grew = (message.reset_counter - last.reset_counter) % 256
            outcome.resets += grew
            # In a tenth of a second nothing walks that far.
            if seconds < 0.1 and far > 1.0 and not grew:
                outcome.faults.append(f"jumped {far:.1f} m uncounted at {now_ns}")
        self._last = message


def walk(base: Path, folder: Path, seed: int, pause: float) -> Scenario:
    """A scenario with faults drawn from the seed instead of its own."""
    rng = np.random.default_rng(seed)
    tables = []
    for sensor in ("uwb", "lidar"):
        at = 6.0 + rng.exponential(pause)
        while at < LONGEST_WALK:
            kind = str(rng.choice([*KINDS, PROTECTION_STOP] if sensor == "lidar" else KINDS))
            duration = 0.1 + rng.exponential(MEAN_FAULT)
            share = float(rng.choice([0.01, 0.1, 0.5]))
            tables.append(
                f'[[faults]]\nsensor = "{sensor}"\nkind = "{kind}"\nat = {at:.3f}\n'
                f"duration = {duration:.3f}\nshare = {share}\n"
            )
            at += duration + rng.exponential(pause)
    path = folder / f"walk{seed}.toml"
    path.write_text(scenario_text(base) + "\n" + "\n".join(tables), encoding="utf-8")
    return load_scenario(path, seed, [])


def soak(minutes: float, seed: int, folder: Path, base: Path = BASE, pause: float = MEAN_PAUSE) -> Outcome:
    """Walk for so many minutes and judge what was sent.

    Args:
        minutes: of simulated time; the last walk is finished.
        seed: of everything random.
        folder: for scenario files.
        base: scenario that is walked.
        pause: from one fault to the next of the same sensor, on average [s].
    """
    outcome = Outcome()
    listener = Listener(outcome)
    onboard: Onboard | None = None
    begin_ns = START_NS
    while outcome.minutes < minutes:
        scenario = walk(base, folder, seed, pause)
        seed += 1
        onboard = onboard or Onboard(scenario.config)
        last_ns = START_NS
        for item in onboard.walk(scenario, scenario.config.pipeline.estimator, begin_ns):
            if isinstance(item, RawChunk):
                last_ns = item.stamp_ns
            else:
                listener.tick(item.tick, item.data.get(NAME, b""), item.now_ns)
        begin_ns += last_ns - START_NS
        outcome.minutes = (begin_ns - START_NS) / 60e9
    return outcome


def main() -> int:
    """Soak as told on the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="of simulated time (default 60)")
    parser.add_argument("--seed", type=int, default=1, help="of the first walk (default 1)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        outcome = soak(arguments.minutes, arguments.seed, Path(folder))
    out = Console(soft_wrap=True)
    states = ", ".join(f"{state} {count}" for state, count in outcome.states.most_common())
    out.print(
        f"{outcome.minutes:.0f} min, {outcome.poses} poses, health lost {outcome.losses} times, last pose "
        f"{outcome.slowest_stop:.3f} s after it at most, {outcome.resets} jumps counted; ticks: {states}"
    )
    out.print(
        "\n".join(outcome.faults[:20]) or "every pose finite, every variance positive, every jump counted"
    )
    return 1 if outcome.faults else 0


if __name__ == "__main__":
    sys.exit(main())
