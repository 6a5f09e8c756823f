"""The viewer's knobs: play, weather and surfaces on and off, haze, size and opacity of particles; where visitors start from.

Nothing here is saved or learned.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from nerfstudio.viewer.viewer_elements import ViewerButton, ViewerCheckbox, ViewerControl, ViewerSlider
from torch import nn

from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene

TICK = 0.04  # s between looks at the clock; the time shown follows the clock however long a render takes


class Panel(nn.Module):
    """Found by the viewer as an attribute of the model; a module only because the viewer descends into modules."""

    def __init__(self, scene: Scene, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds
        # Shown in the alphabetical order of their names here.
        self.play = ViewerButton("Play / pause", self._toggle)
        self.shown = ViewerCheckbox("Weather", True, hint="Off: the frozen scene alone")
        self.size = ViewerSlider("Flake size", 1.0, 0.25, 4.0, 0.05, hint="Times the learned size")
        self.speed = ViewerSlider("Speed", 1.0, 0.1, 4.0, 0.1, hint="Seconds of weather per second")
        self.visibility = ViewerSlider("Flake opacity", 1.0, 0.0, 1.0, 0.05, hint="Times the learned opacity")
        self.surfaces = ViewerCheckbox("Surfaces and light", True, hint="Off: the scene stays as dry, bare and bright as it is")
        self.haze = ViewerSlider("Haze", 1.0, 0.0, 4.0, 0.1, hint="Times the extinction of fog, dust or rain in the air")
        self.control = Entrance(scene)
        self._thicker: tuple[int, float, Answer] | None = None
        self._playing = threading.Event()
        self._player: threading.Thread | None = None

    def adjusted(self, weather: Gaussians) -> Gaussians | None:
        """The weather as the knobs want it; None where it is switched off."""
        if not self.shown.value:
            return None
        if self.size.value == 1.0 and self.visibility.value == 1.0:
            return weather
        return replace(weather, scales=weather.scales * self.size.value, opacities=weather.opacities * self.visibility.value)

    def adjusted_answer(self, answer: Answer) -> Answer | None:
        """The scene's answer as the knobs want it; None where it stays as it was trained."""
        if not (self.shown.value and self.surfaces.value):
            return None
        if self._thicker is None or self._thicker[:2] != (answer.number, self.haze.value):
            self._thicker = answer.number, self.haze.value, answer.thicker(self.haze.value)
        return self._thicker[2]

    def _toggle(self, _: ViewerButton) -> None:
        if self._playing.is_set():
            self._playing.clear()
            return
        self._playing.set()
        if self._player is None or not self._player.is_alive():
            self._player = threading.Thread(target=self._run, name="pgsd-play", daemon=True)
            self._player.start()

    def _run(self) -> None:
        """Move the viewer's time with the clock, over and over, as long as somebody looks on."""
        viewer = self.control.viewer
        last = time.monotonic()
        while self._playing.is_set() and viewer.viser_server.get_clients():
            time.sleep(TICK)
            now = time.monotonic()
            viewer.control_panel.time = (viewer.control_panel.time + self.speed.value * (now - last) / self.seconds) % 1.0
            last = now
            viewer._trigger_rerender()
        self._playing.clear()


class Entrance(ViewerControl):
    """Visitors start at the first training view instead of in the middle of the scene, with the scene's own up.

    A little before it, since the viewer hangs the view's own picture up there.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        viewer.viser_server.scene.set_up_direction(tuple(self._scene.frame.rotation[2].tolist()))
        viewer.viser_server.on_client_connect(self._welcome)

    def _welcome(self, client: Any) -> None:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        pose = self._scene.cameras.opengl()[0]
        center, forward = pose[:3, 3], -pose[:3, 2]
        # Dragging turns about the point in view that is nearest to the middle of the scene.
        ahead = ((self._scene.frame.origin - center) @ forward).clamp_min(1e-3)
        past_picture = 3 * self.viewer.config.camera_frustum_scale * forward
        with client.atomic():
            client.camera.position = (center * VISER_NERFSTUDIO_SCALE_RATIO + past_picture).numpy()
            client.camera.look_at = ((center + ahead * forward) * VISER_NERFSTUDIO_SCALE_RATIO + past_picture).numpy()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Keep the viewer from breaking off a computation whose half result would be kept.

    Its render thread watches every line that runs and raises out of the middle of it when the camera moves.
    """
    watching = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(watching)
