"""The model nerfstudio sees: the frozen scene with the weather of any moment in it.

Which moment a camera sees is said in `plugin.moments`. Pictures along a path have even sizes, since videos of odd ones are
written in a way (4:4:4) that few players show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.base_model import Model
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from rich.console import Console
from torch import Tensor
from torch.nn import Parameter

from pgsd_nerfstudio.dynamics import Deformation, DeformedCloud, DynamicsField, LearnedLook, Rollout
from pgsd_nerfstudio.dynamics.sequence import GaussianSequence
from pgsd_nerfstudio.dynamics.sparkle import Sparkle
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.moments import Moments, place_in_path
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.plugin.panel import Panel, uninterrupted
from pgsd_nerfstudio.plugin.run_cameras import from_nerfstudio
from pgsd_nerfstudio.plugin.splat import splat_tensors
from pgsd_nerfstudio.plugin.views import BACKGROUND
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.rasterizer import Rasterizer, Rendering
from pgsd_nerfstudio.response.answer import Answer, Shown
from pgsd_nerfstudio.response.baked import baked
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.storage import content_key
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene
from pgsd_nerfstudio.weather.weather import Weather

DIGEST = "digest"
MOST_PIXELS = 2**26  # 8192 x 8192: more than any video format takes
STRIDE = 8  # frames between kept states: a jump in time, and what lies in a training clip, costs 3.5 frames on average


@dataclass
class WeatherModelConfig(SplatfactoModelConfig):
    """A splatfacto by type, since viewer and ns-export ask for that; none of its training is used."""

    _target: type = field(default_factory=lambda: WeatherModel)
    options: tyro.conf.Suppress[RunOptions] = field(default_factory=RunOptions.unset)


class WeatherModel(SplatfactoModel):
    """Frozen scene plus learned weather. Only what is learned lies in the checkpoint."""

    config: WeatherModelConfig

    def __init__(self, *args: Any, made: Weather, exporting: bool = False, **kwargs: Any) -> None:
        """Wrap a weather, which stays outside of the module's state.

        Args:
            args: of nerfstudio's models.
            made: the weather of the run, simulated.
            exporting: whether `gauss_params` are asked for in earnest.
            kwargs: of nerfstudio's models.
        """
        self.made, self.exporting = made, exporting
        super().__init__(*args, **kwargs)

    @property
    def prepared(self) -> PreparedScene:
        """The frozen scene on the model's device."""
        return self.made.prepared

    @property
    def history(self) -> ParticleHistory:
        """The simulated motion."""
        return self.made.history

    @property
    def answer(self) -> Answer:
        """How the frozen scene looks under the weather."""
        return self.made.answer

    def populate_modules(self) -> None:
        Model.populate_modules(self)  # not splatfacto's, which needs CUDA and downloads weights
        self.look = LearnedLook().to(self.history.device)
        self.field, self.rollout = self._sequence()
        self.made = self.made.shown_by(self.rollout)
        self._refreshed: dict[str, Tensor] | None = None
        self.weather = Panel(self.prepared.scene, self.config.options.simulation.seconds)
        self.background_color = torch.tensor(BACKGROUND)
        self.crop_box: OrientedBox | None = None
        self.moments = Moments(self.made.frame_count / self.made.fps, self.made.frame_count, _say)
        self._cropped: tuple[Any, Tensor, Rasterizer] | None = None
        self._cropped_answer: tuple[int, Tensor, Answer] | None = None
        self._exported: dict[str, Tensor] | None = None

    def _sequence(self) -> tuple[torch.nn.Module, GaussianSequence]:
        """What is learned of motion and appearance, and the sequence that shows it."""
        options, history, look = self.config.options.motion, self.history, self.made.look
        if options.motion == "deformation":
            box = torch.tensor(history.about["domain"]).reshape(2, 3).to(history.device)
            deformation = Deformation(box, history.frames).to(history.device)
            return deformation, DeformedCloud(history, look, deformation, self.look)
        dynamics = DynamicsField.for_history(history, config=options.dynamics)
        shown = self.made.effect.appearance
        how = {"stride": STRIDE, "exposure": shown.exposure, "motion": options.motion, "sparkle": Sparkle.of(shown.active)}
        return dynamics, Rollout(history, look, dynamics, self.look, **how)

    def get_extra_state(self) -> dict[str, Any]:
        """Weights with which the states were made that clips take what lies from: interrupted training goes on with them. And a
        digest of all that is learned, since torch reads a checkpoint whose bits have changed as if nothing were amiss."""
        kept = dict(self.rollout.refreshed or {})
        return {**kept, DIGEST: self._digest(kept)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._refreshed = {name: value for name, value in state.items() if name != DIGEST} or None

    def _digest(self, kept: dict[str, Tensor]) -> str:
        return content_key({name: parameter.detach() for name, parameter in self.named_parameters()}, kept)

    def go_on(self) -> None:
        """Training goes on after a checkpoint was loaded: to the same bits as if it had not been broken off."""
        if self._refreshed is not None and isinstance(self.rollout, Rollout):
            self.rollout.restore(self._refreshed)
        self._refreshed = None

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        return {"field": list(self.field.parameters()), "look": list(self.look.parameters())}

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """None of splatfacto's: nothing is split or culled."""
        return []

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, **kwargs: Any) -> Any:  # type: ignore[override]
        """Load what was learned; always strict, since a field that is half loaded looks trained and is not.

        Raises:
            RunError: the checkpoint lacks a tensor, has one too many or one of another shape, or is not what was stored.
        """
        try:
            loaded = torch.nn.Module.load_state_dict(self, state_dict, strict=True)
            stored = state_dict["_extra_state"][DIGEST]
        except (RuntimeError, KeyError, TypeError, AttributeError) as error:
            reasons = " ".join(line.strip() for line in str(error).splitlines()[1:]) or repr(error)
            raise RunError(f"the checkpoint does not fit this version of pgsd_nerfstudio, train again: {reasons}") from error
        if stored != self._digest(self._refreshed or {}):
            raise RunError(
                "the checkpoint is damaged: it holds something else than was stored; take an older one or train again"
            )
        return loaded

    def weather_at(self, frame: int, camera: Cameras | None = None) -> Gaussians:
        """The weather's Gaussians in scene units at a frame of its time line, learned refinements included.

        Args:
            frame: number of the frame.
            camera: one camera that will see them, as for `Weather.gaussians`; None: all of them.
        """
        with uninterrupted():
            return self.made.gaussians(frame, camera)

    def moment(self, frame: int, answer: Answer | None = None) -> Shown | None:
        """How the frozen scene looks at a frame; None: as it was trained."""
        return (answer or self.answer).at(frame / self.history.fps)

    def get_outputs_for_camera(self, camera: NerfstudioCameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """One picture: rgb [H, W, 3], depth [H, W, 1] in scene units, accumulation [H, W, 1] and background [H, W, 3].

        Raises:
            SceneError: the camera is not a perspective one, or its path has times that are none of the weather.
            RunError: the picture has no pixels, or too many.
        """
        views = from_nerfstudio(camera).to(self.device)
        if place_in_path(camera) is not None:
            views = Cameras(views.viewmats, views.Ks, views.width // 2 * 2, views.height // 2 * 2)
        if min(views.width, views.height) < 1 or views.width * views.height > MOST_PIXELS:
            raise RunError(
                f"the pictures would have {views.width}x{views.height} pixels: expected at least one each way and at most "
                f"{MOST_PIXELS:,} in all, use another --downscale-factor or size of the camera path"
            )
        frame = self.moments.of(camera)
        answer = self.weather.adjusted_answer(self.answer)
        return self._outputs(self.render(views, self.weather.adjusted(self.weather_at(frame, views)), obb_box, answer, frame))

    def get_outputs(self, ray_bundle: Any) -> dict[str, Tensor]:
        """As `get_outputs_for_camera`; rays, which ns-export pointcloud, tsdf, poisson and marching-cubes ask for, are refused.

        Raises:
            RunError: the bundle is one of rays.
        """
        if not isinstance(ray_bundle, NerfstudioCameras):
            raise RunError(
                "the weather is rasterized: it has no answer for single rays; of the exports there is ns-export gaussian-splat"
            )
        return self.get_outputs_for_camera(ray_bundle)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Float[Tensor, "h w 4"]:
        """The picture without what lies behind the scene, and how opaque it is: laid over the background again it is `rgb`.

        Haze before nothing is opaque too, as much as it has to be for its colour.

        Args:
            outputs: of `get_outputs_for_camera`.
            output_name: rgb; there is no other.
        """
        rgb, behind = outputs["rgb"], outputs["background"]
        needed = torch.maximum((rgb - behind) / (1.0 - behind), 1.0 - rgb / behind).amax(dim=2, keepdim=True)
        alpha = torch.maximum(outputs["accumulation"], needed).clamp(0.0, 1.0)
        alone = (rgb - (1.0 - alpha) * behind) / alpha.clamp_min(1e-6)
        return torch.cat([alone.clamp(0.0, 1.0), alpha], dim=2)

    def render(
        self,
        views: Cameras,
        weather: Gaussians | None,
        box: OrientedBox | None = None,
        answer: Answer | None = None,
        frame: int = 0,
    ) -> Rendering:
        """One view of the scene with some weather or none, and with its answer at a frame or as it was trained; no gradient."""
        rasterizer = self.prepared.rasterizer
        with torch.no_grad(), uninterrupted():
            if box is not None:
                inside, rasterizer = self._inside(box)
                weather = None if weather is None else weather.select(box.within(weather.means).reshape(-1))
                answer = None if answer is None else self._part(answer, inside)
            moment = None if answer is None else self.moment(frame, answer)
            return rasterizer.render(views, weather, self.background_color.to(self.device), moment)

    def _inside(self, box: OrientedBox) -> tuple[Tensor, Rasterizer]:
        """Which of the frozen scene lies in the viewer's crop box, and its rasterizer; the last one is kept."""
        key = [tuple(t.flatten().tolist()) for t in (box.R, box.T, box.S)]
        if self._cropped is None or self._cropped[0] != key:
            frozen = self.prepared.rasterizer.frozen
            inside = box.within(frozen.means).reshape(-1)
            self._cropped = (key, inside, choose_rasterizer(frozen.select(inside), self.device))
        return self._cropped[1:]

    def _part(self, answer: Answer, inside: Tensor) -> Answer:
        """The answer of what lies in the crop box, the last one kept: a new one would make all prepared views useless."""
        if self._cropped_answer is None or self._cropped_answer[0] != answer.number or self._cropped_answer[1] is not inside:
            self._cropped_answer = answer.number, inside, answer.select(inside)
        return self._cropped_answer[2]

    def _outputs(self, rendering: Rendering) -> dict[str, Tensor]:
        rgb = rendering.rgb[0].clamp(0, 1)
        return {
            "rgb": rgb,
            "depth": rendering.depth[0, ..., None],
            "accumulation": rendering.accumulation[0, ..., None],
            "background": self.background_color.to(rgb).expand_as(rgb),
        }

    @property
    def gauss_params(self) -> dict[str, Float[Tensor, "..."]]:  # type: ignore[override]
        """What ns-export writes, as splatfacto's tensors: the scene with the weather of the moment `export_time`.

        A viewer, which only marks the centres with a hidden cloud of points, gets the frozen scene alone.
        """
        if self._exported is None:
            frame = self.moments.at(self.config.options.export_time)
            frozen, weather = self.prepared.scene.gaussians, Gaussians.empty()
            if self.exporting:
                weather = self.weather_at(frame).to("cpu")
                frozen = baked(self.moment(frame), frozen.to(self.device)).to("cpu")
            self._exported = splat_tensors(frozen, weather)
        return self._exported

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Tensor]:
        """Losses live in the pipeline: they concern clips, not pictures."""
        return {}

    def get_metrics_dict(self, outputs: Any, batch: Any) -> dict[str, Tensor]:
        return {}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """How much of the picture the weather changed; photographs are no truth for a scene in which it now snows."""
        truth, rgb = batch["image"][..., :3].to(outputs["rgb"]), outputs["rgb"]
        return {"changed_by_weather": float((rgb - truth).abs().mean())}, {"img": torch.cat([truth, rgb], dim=1)}


def _say(line: str) -> None:
    Console(stderr=True, highlight=False).print(line, style="dim", markup=False, soft_wrap=True)
