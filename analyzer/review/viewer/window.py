"""The viewer in a window of its own."""

from collections.abc import Callable, Sequence

import numpy as np
from rerun.experimental import ViewerClient

from hearthlog.analyzer.review.viewer.process import ViewerProcess, check_display
from hearthlog.analyzer.review.viewer.viewer import Blueprint, Viewer, ViewerState

_MEMORY = "800MB"  # of a viewer that data comes to for days; then it drops the oldest


class _WindowControl:
    """Controls a viewer by Rerun's own client, over gRPC."""

    def __init__(self, process: ViewerProcess) -> None:
        self.process = process
        self._client: ViewerClient | None = None

    @property
    def client(self) -> ViewerClient:
        if self._client is None:
            self._client = ViewerClient.connect(self.process.url)
        return self._client

    def state(self) -> ViewerState:
        state = self.client.get_state()
        errors = [
            f"{view.name}: {report.summary}" for view in state.views for report in view.reports
        ]
        cursors = [
            each.current_time
            for each in state.recordings
            if each.store_id == state.active_recording
        ]
        cursor = cursors[0] if cursors else None
        return ViewerState(state.viewer_version or "", len(state.views), errors, cursor)

    def blueprint(self) -> Blueprint:
        return self.client.get_blueprint().blueprint

    def set_blueprint(self, blueprint: Blueprint) -> None:
        self.client.set_blueprint(blueprint, of="recording")

    def set_time(self, axis: str, nanoseconds: int, *, play: bool) -> None:
        self.client.set_time(
            axis,
            timestamp=np.datetime64(nanoseconds, "ns"),
            play_state="playing" if play else "paused",
        )

    def offer(self, keys: Sequence[tuple[str, str]], press: Callable[[str], None]) -> None:
        """Offer nothing: keys are those of the terminal."""

    def say(self, text: str) -> None:
        """Say nothing: lines are those of the terminal."""

    def close(self) -> None:
        self.process.close()


class WindowViewer(Viewer):
    """A viewer in a window of its own."""

    def __init__(self, process: ViewerProcess) -> None:
        self._window = _WindowControl(process)
        super().__init__(self._window)

    def picture(self) -> bytes:
        """Return a picture of the window as PNG.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        return self._window.client.take_screenshot()


def open_window(port: int | None = None, data: str | None = None) -> WindowViewer:
    """Open Rerun's viewer in a window.

    Raise `DataError` if there is no display, the viewer is not installed, or the port is in
    use.
    """
    check_display(
        "--save FILE.rrd to make a file that Rerun opens elsewhere, with --queue FILE.txt to "
        "correct it by hand"
        if data is None
        else "--serve to look from another machine"
    )
    if data is None:
        return _opened(port, "--expect-data-soon")
    return _opened(port, "--connect", data, "--memory-limit", _MEMORY)


def open_hidden(port: int | None = None) -> WindowViewer:
    """Run the viewer without a window, for pictures.

    Raise `DataError` if the viewer is not installed, or the port is in use.
    """
    return _opened(port, "--expect-data-soon", "--headless")


def _opened(port: int | None, *more: str) -> WindowViewer:
    limit = ["--server-memory-limit", "32MB"]  # no other viewer connects later
    return WindowViewer(ViewerProcess(["--hide-welcome-screen", *limit, *more], port))
