"""The RPLIDAR models that can be emulated: who they say they are, and how they can scan."""

from dataclasses import dataclass

from drivers.rplidar_protocol import AnswerType


@dataclass(frozen=True, slots=True)
class ScanMode:
    """One way of scanning.

    Attributes:
        name: the vendor's.
        kind: of its packets.
        sample_us: time that one sample takes [us].
    """

    name: str
    kind: AnswerType
    sample_us: float


@dataclass(frozen=True, slots=True)
class LidarModel:
    """One model.

    Attributes:
        model: byte of the answer to GET_INFO.
        firmware: major, minor; below 1.24 it knows no configuration queries.
        modes: by their numbers.
        typical: number of the mode that the vendor recommends.
        max_distance: farthest target that it claims [m].
    """

    model: int
    firmware: tuple[int, int]
    modes: tuple[ScanMode, ...]
    typical: int
    max_distance: float


def _triangulating(
    standard: float, express: float, boost: float, sensitivity: float, stability: float
) -> tuple[ScanMode, ...]:
    """Modes of the A series [us]."""
    return (
        ScanMode("Standard", AnswerType.STANDARD_SCAN, standard),
        ScanMode("Express", AnswerType.EXPRESS_SCAN, express),
        ScanMode("Boost", AnswerType.ULTRA_SCAN, boost),
        ScanMode("Sensitivity", AnswerType.ULTRA_SCAN, sensitivity),
        ScanMode("Stability", AnswerType.ULTRA_SCAN, stability),
    )


def _pulsed(standard: float, dense: float, kind: AnswerType = AnswerType.DENSE_SCAN) -> tuple[ScanMode, ...]:
    """Modes of the C and S series [us]."""
    return (ScanMode("Standard", AnswerType.STANDARD_SCAN, standard), ScanMode("DenseBoost", kind, dense))


# Modes of A1, A2M12 and S1 as real devices list them; sample rates of A2, A3 and S2 from protocol figure 3-3.
# The rates of C1 and S3, and that S3 sends ultra-dense packets, are assumptions.
LIDAR_MODELS = {
    "A1": LidarModel(0x18, (1, 29), _triangulating(508, 254, 127, 127, 201), 3, 12.0),
    "A1-old": LidarModel(0x18, (1, 20), _triangulating(508, 254, 127, 127, 201)[:2], 1, 12.0),
    "A2": LidarModel(0x28, (1, 29), _triangulating(500, 250, 125, 125, 125), 2, 16.0),
    "A2M12": LidarModel(0x2C, (1, 32), _triangulating(252, 126, 63, 63, 100), 3, 12.0),
    "A3": LidarModel(0x31, (1, 29), _triangulating(250, 125, 62.5, 62.5, 62.5), 3, 25.0),
    "C1": LidarModel(0x41, (1, 1), _pulsed(200, 200), 1, 12.0),
    "S1": LidarModel(0x61, (1, 28), _pulsed(244, 108), 1, 40.0),
    "S2": LidarModel(0x71, (1, 1), _pulsed(62.5, 31.25), 1, 30.0),
    "S3": LidarModel(0x81, (1, 1), _pulsed(62.5, 31.25, AnswerType.ULTRA_DENSE_SCAN), 1, 40.0),
}
