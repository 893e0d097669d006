"""Measurement and motion models: value, Jacobian, covariance; shared by every estimator."""
