"""Estimation mathematics: no I/O, no clock, nothing of ours but the measurement types."""
