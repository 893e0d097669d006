"""Positions from UWB ranges alone, and from UWB with an inertial sensor: the methods of li2022."""
