"""Which ranges of a frame a filter believes: shared by all that hold a prediction against them."""

from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict, Field
from scipy.stats import chi2

from estimators.base import Setup, Verdict
from estimators.messages import FloatArray, RangeFrame
from estimators.models.range import reduce_height


class RangeGate:
    """Height reduction of known anchors' ranges, NIS gate, and doubt about anchors that failed it.

    What blocks a range does not go away at once: an anchor that was gated is not believed for a while, even
    when its range is near the prediction.
    """

    class Config(BaseModel):
        """Settings of every filter on ranges."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        range_sigma: float = Field(0.10, gt=0, le=10, description="standard deviation of a range [m]")
        range_gate: float = Field(
            0.997, gt=0.5, lt=1, description="share of good ranges that pass the NIS gate"
        )
        suspect_for: float = Field(
            0.5,
            ge=0,
            le=60,
            description="after a range that failed the gate, its anchor is not believed for so long [s]: "
            "what blocks a range does not go away at once",
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._setup = setup
        self._sigma = config.range_sigma
        self._limit = float(chi2.ppf(config.range_gate, 1))
        self._suspect_ns = round(config.suspect_for * 1e9)
        self.reset()

    def reset(self) -> None:
        """Trust every anchor."""
        self._gated_ns: dict[int, int] = {}

    def horizontal(self, frame: RangeFrame) -> Iterator[Verdict | tuple[FloatArray, float, float]]:
        """For each range of a frame the anchor (3,), horizontal range and its sigma [m], or what is wrong."""
        for anchor_id, slant in zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True):
            anchor = self._setup.anchors.get(anchor_id)
            if anchor is None:
                yield Verdict.UNKNOWN_ANCHOR
                continue
            reduced = reduce_height(slant, self._sigma, self._setup.height_to(anchor))
            yield Verdict.IMPOSSIBLE if reduced is None else (anchor, *reduced)

    @property
    def limit(self) -> float:
        """Greatest NIS that passes."""
        return self._limit

    def doubts(self, anchor_id: int, stamp_ns: int) -> bool:
        """Whether a range of this anchor was gated a moment ago."""
        gated_ns = self._gated_ns.get(anchor_id)
        return gated_ns is not None and stamp_ns - gated_ns < self._suspect_ns

    def judge(self, anchor_id: int, stamp_ns: int, nis: float) -> Verdict:
        """Verdict on a range of a known anchor.

        Args:
            anchor_id: whose range it is.
            stamp_ns: when it was measured.
            nis: normalised innovation squared, before the range is used.
        """
        if nis > self._limit:
            self._gated_ns[anchor_id] = stamp_ns
            return Verdict.GATED
        return Verdict.SUSPECT if self.doubts(anchor_id, stamp_ns) else Verdict.ACCEPTED
