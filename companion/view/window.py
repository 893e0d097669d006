"""A viewer that is shown something live, and is sent no more than it takes."""

import rerun as rr

from companion.view.files import APPLICATION
from companion.view.viewer import Viewer

KEEPS_UP = 1.0
"""A viewer that has not taken a batch after so long [s] is not sent another before it has."""


class Window:
    """A viewer and the stream to it.

    Args:
        viewer: that is to show it.
        name: of what is shown.

    Raises:
        UserError: the viewer does not start.
    """

    def __init__(self, viewer: Viewer, name: str) -> None:
        viewer.wait_until_ready()
        self._viewer = viewer
        self.stream = rr.RecordingStream(APPLICATION)
        self.stream.connect_grpc(viewer.url)
        self.stream.send_recording_name(name)
        self._keeps_up = True

    @property
    def is_open(self) -> bool:
        """False once the viewer was closed, or died."""
        return self._viewer.is_running

    def is_ready(self) -> bool:
        """Whether the viewer has taken what it was sent; waits for one that has kept up so far."""
        return self._keeps_up or self.take()

    def take(self) -> bool:
        """Hand over what is in the stream; False when the viewer does not take it in time."""
        try:
            self.stream.flush(timeout_sec=KEEPS_UP)
            self._keeps_up = True
        except RuntimeError:
            self._keeps_up = False
        return self._keeps_up

    def close(self) -> None:
        """End a page; a window stays until it is closed, unless it has stalled."""
        if self.is_open and self.take() and not self._viewer.is_page:
            self.stream.disconnect()
        else:
            # First the viewer: a stream that waits for it would never end.
            self._viewer.kill()
