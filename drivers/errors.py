"""What can go wrong with hardware; bad data never raises, it is counted."""


class DriverError(Exception):
    """A device or its port cannot be used as asked."""


class PortError(DriverError):
    """A port cannot be opened, or was lost while open."""
