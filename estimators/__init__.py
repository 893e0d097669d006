"""Estimation mathematics: no I/O, no clock, nothing of ours but the measurement types."""

from importlib import import_module
from typing import Any, cast

from pydantic import BaseModel

from estimators.base import Estimator, Settable, Setup

ESTIMATORS: dict[str, tuple[str, str]] = {
    "ekf": ("estimators.ekf", "Ekf"),
    "gd": ("estimators.uwb.gradient_descent", "GradientDescent"),
    "gd_pf": ("estimators.uwb.gd_pf", "GdPf"),
    "graph": ("estimators.graph.smoother", "GraphSmoother"),
    "least_squares": ("estimators.least_squares", "LeastSquares"),
    "lidar_odometry": ("estimators.lidar.odometry", "LidarOdometry"),
    "linear_ls": ("estimators.uwb.gradient_descent", "LinearLeastSquares"),
    "momentum_gd": ("estimators.uwb.gradient_descent", "MomentumGradientDescent"),
    "pf": ("estimators.particle_filter", "ParticleFilter"),
    "pf_ibas": ("estimators.pf_ibas", "PfIbas"),
    "pf_ibas_graph": ("estimators.graph.pf_ibas_graph", "PfIbasGraph"),
    "pf_ibas_printed": ("estimators.pf_ibas", "PrintedPfIbas"),
    "uwb_imu_adaptive_ekf": ("estimators.uwb.uwb_imu_adaptive_ekf", "UwbImuAdaptiveEkf"),
    "uwb_imu_ekf": ("estimators.uwb.uwb_imu_ekf", "UwbImuEkf"),
}
"""Name on the command line -> module and class. The class has a nested pydantic `Config`."""


def _estimator_class(name: str) -> Any:
    module, class_name = ESTIMATORS[name]
    return getattr(import_module(module), class_name)


def estimator_config_class(name: str) -> type[BaseModel]:
    """Config class of the named estimator.

    Raises:
        KeyError: no estimator has that name.
    """
    return cast("type[BaseModel]", _estimator_class(name).Config)


def uses_closures(name: str) -> bool:
    """Whether the named estimator takes loop closures: it has a setting `places` then."""
    return "places" in estimator_config_class(name).model_fields


def make_estimator(
    name: str, config: BaseModel, setup: Setup, relocation: BaseModel | None = None
) -> Estimator:
    """New estimator of the given name.

    Args:
        name: a key of `ESTIMATORS`.
        config: instance of its `Config`.
        setup: geometry of the site.
        relocation: settings of `Recovering`, with which a filter on ranges finds its start and itself again;
            None to believe the start.
    """
    from estimators.range_gate import RangeGate
    from estimators.relocation.recovery import Recovering

    estimator = cast("Estimator", _estimator_class(name)(config, setup))
    if (
        isinstance(relocation, Recovering.Config)
        and relocation.enabled
        and isinstance(estimator, Settable)
        and isinstance(config, RangeGate.Config)
    ):
        return Recovering(estimator, relocation, config.range_sigma, setup)
    return estimator
