"""The only place that knows NED and FRD: link to the autopilot and pose output."""
