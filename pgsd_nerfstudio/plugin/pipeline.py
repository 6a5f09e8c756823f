"""From a config to a scene with weather: opens the scene, prepares or reads the motion prior, and takes training steps.

Only under nerfstudio's Trainer is anything simulated and the video prior opened; viewer, render, eval and export read what the
run kept.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import psutil
import torch
import torchvision
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import Pipeline, VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils import writer
from rich.console import Console
from torch import Tensor

from pgsd_nerfstudio.dynamics import Begin, Gap, Rollout, drift, gaps, regularization
from pgsd_nerfstudio.dynamics.in_sight import Eye, faded_in
from pgsd_nerfstudio.guidance.distillation import DistilledClip
from pgsd_nerfstudio.guidance.schedules import regularization_scale
from pgsd_nerfstudio.plugin.clip import Stopwatch, render_clip, seen_by, surrogate
from pgsd_nerfstudio.plugin.datamanager import TrajectoryDataManager, TrajectoryDataManagerConfig
from pgsd_nerfstudio.plugin.distiller import Distiller, open_prior
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.fidelity import fidelity
from pgsd_nerfstudio.plugin.model import WeatherModel, WeatherModelConfig
from pgsd_nerfstudio.plugin.opening import keep_weather, prepare_weather, resumed_weather, stored_weather
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.plugin.run_cameras import from_nerfstudio
from pgsd_nerfstudio.plugin.summary import print_summary

GAP_CLIPS = 4  # clips, which training does not see, that the drift is compared on
MAX_SKIPPED = 2  # steps in a row that may pass without a gradient; one more ends the run

console = Console(stderr=True, highlight=False)


@dataclass
class WeatherPipelineConfig(VanillaPipelineConfig):
    """What data manager, model and pipeline share is set by the trainer's configuration, not by flags."""

    _target: type = field(default_factory=lambda: WeatherPipeline)
    datamanager: TrajectoryDataManagerConfig = field(default_factory=TrajectoryDataManagerConfig)
    model: WeatherModelConfig = field(default_factory=WeatherModelConfig)
    options: RunOptions = field(default_factory=RunOptions.unset)
    run_folder: Path | None = None
    resumed_folder: Path | None = None
    """Of the run that training goes on from."""

    def share(self, options: RunOptions) -> None:
        """One record of options for all three."""
        self.options = self.datamanager.options = self.model.options = options


class WeatherPipeline(VanillaPipeline):
    """PreparedScene, motion prior, model and, in training, the distiller."""

    config: WeatherPipelineConfig
    datamanager: TrajectoryDataManager
    _model: WeatherModel

    def __init__(
        self,
        config: WeatherPipelineConfig,
        device: str | torch.device,
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: Any = None,
    ) -> None:
        """Open a run; with a grad_scaler, which only the Trainer passes, prepare it for training.

        Raises:
            SceneError: the scene cannot be used.
            RunError: the motion prior or the video prior cannot be made or found.
        """
        Pipeline.__init__(self)
        self.completed: int | None = None
        """The last training step that was done as a whole."""
        self._skipped = self._skipped_in_all = 0
        self._layers_judged = False
        self.config, self.test_mode, self.world_size = config, test_mode, world_size
        self.distiller: Distiller | None = None
        prior = None
        if grad_scaler is not None:
            # First, since a wrong path there should cost nothing yet.
            prior, settled = open_prior(config.options, device)
            config.share(settled)
        config.datamanager.run_folder = config.run_folder
        self.datamanager = config.datamanager.setup(
            device=device, test_mode=test_mode, world_size=world_size, local_rank=local_rank
        )
        prepared, options = self.datamanager.prepared, config.options
        if prior is None:
            weather = stored_weather(prepared, options, config.run_folder)
        else:
            weather = resumed_weather(prepared, options, config.resumed_folder) or prepare_weather(prepared, options)
        self._model = config.model.setup(
            scene_box=self.datamanager.train_dataset.scene_box,
            num_train_data=len(self.datamanager.train_dataset),
            made=weather,
            exporting=test_mode == "inference",
        )
        self._model.to(device)
        if prior is not None:
            self.distiller = Distiller.of(prior, config.options, weather.scene.description)
            if config.run_folder is not None:
                keep_weather(weather, config.run_folder)
            print_summary(console, config.options, weather, self.distiller)

    @property
    def model(self) -> WeatherModel:
        """The model; there is no distributed training that would wrap it."""
        return self._model

    def _judge_layers(self, clip: Tensor, exact: Tensor) -> None:
        """Say once what pressing the frozen scene into layers costs in accuracy, on the first clip of the run."""
        self._layers_judged = True
        psnr = -10.0 * float((clip - exact).square().mean().clamp_min(1e-20).log10())
        console.print(f"layers {self.config.options.clips.layers}: the first clip lies {psnr:.1f} dB from the exact one")

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
        """Losses of one clip: score distillation of the video, and what holds motion and look near the simulation.

        Raises:
            RunError: the video prior's predictions are not finite, several steps in a row.
        """
        if self.distiller is None:
            raise RunError("this run was opened to look at, not to train")
        model, options = self.model, self.config.options
        prepared, watch = model.prepared, Stopwatch(model.prepared.device)
        cameras, batch = self.datamanager.next_train(step)
        views, start = from_nerfstudio(cameras), int(batch["start"])
        background = model.background_color.to(prepared.device)
        model.go_on()
        if step % options.learning.refresh_every == 0:
            with watch("refresh"):
                model.rollout.refresh()
        with watch("roll-out"):
            # What is deformed is not where it was scattered.
            seen = None if options.motion.motion == "deformation" else seen_by(prepared, views, model.history, start)
            how = {"begin": options.motion.begin, "gradient_frames": options.motion.gradient_frames}
            instants = model.rollout.window(start, len(views), visible=seen, **how)
            place, config = prepared.scene.frame, prepared.clip_rasterizer.config
            eyes = [Eye.of(views[k], config, place) for k in range(len(views))]
            reaches = model.history.reaches
            shown = [faded_in(one, reaches, eye) for one, eye in zip(instants, eyes, strict=True)]
            if options.knows_wide_flakes:
                shown = [replace(one, antialiased=False, whole=False) for one in shown]
            weather = [place.gaussians_to_scene(one) for one in shown]
        with watch("render"):
            answering = options.answering_clips
            moments = [model.moment(start + k) if answering else None for k in range(len(views))]
            clip = render_clip(prepared, views, weather, background, moments)
        if prepared.clip_rasterizer is not prepared.rasterizer and not self._layers_judged:
            exact = replace(prepared, clip_rasterizer=prepared.rasterizer)
            self._judge_layers(clip, render_clip(exact, views, weather, background, moments))
        with watch("video prior"):
            distilled = self._distilled(clip, step)
        with watch("render, backward"):
            video, norms = surrogate(prepared, views, weather, background, moments, distilled.gradient)
        weights = options.motion.regularization
        with watch("regularize"):
            terms = regularization(instants, model.look, weights.form)
            scale = regularization_scale(options.motion.weights, distilled.loss, step, options.training_steps)
            losses = weights.weighted(terms, scale)
        with torch.no_grad():
            metres = drift(instants)
        if options.clips.clip_every and step % options.clips.clip_every == 0:
            writer.put_image("clip", torch.cat(list(clip), dim=2).permute(1, 2, 0).cpu(), step)
        # The number shown is |L_SDS|, the gradient that of the surrogate.
        losses = {"video": video - video.detach() + distilled.loss, **losses}
        metrics = {
            "sds": distilled.loss,
            "timestep": distilled.timestep,
            "drift_m": metres,
            "skipped": self._skipped_in_all,
            "memory_mb": _memory(prepared.device),
            **{f"weight/{name}": weights.scaled(name, scale) for name in terms},
            "particles_seen": len(model.history) if seen is None else int(seen.sum()),
            **{f"gradient/{name}": norm for name, norm in norms.items()},
            **{f"seconds/{name}": seconds for name, seconds in watch.seconds.items()},
        }
        return {}, losses, {name: torch.tensor(float(value)) for name, value in metrics.items()}

    def _distilled(self, clip: Tensor, step: int) -> DistilledClip:
        """The distiller's answer; a single one that is not finite counts as none."""
        assert self.distiller is not None
        try:
            distilled = self.distiller.gradient(clip, step)
        except FloatingPointError as error:
            self._skipped += 1
            self._skipped_in_all += 1
            if self._skipped > MAX_SKIPPED:
                raise RunError(f"{self._skipped} steps in a row gave nothing: {error}") from error
            console.print(f"[yellow]step {step} gives no gradient: {error}[/]")
            return DistilledClip(torch.zeros_like(clip), 0.0, 0)
        self._skipped = 0
        return distilled

    def get_eval_loss_dict(self, step: int) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
        """Drift over one window that training does not see."""
        _, batch = self.datamanager.next_eval(step)
        start, frames = int(batch["start"]), self.config.options.clips.clip_frames or 1
        metres = drift(self.model.rollout.frames(start, start + frames))
        return {}, {"drift_m": torch.tensor(metres)}, {}

    def drift_gaps(self) -> dict[Begin, Gap]:
        """Drift of clips, begun in either way, against that of the whole roll-out; {} where there is no simulation."""
        rollout = self.model.rollout
        if not isinstance(rollout, Rollout):
            return {}
        starts = [int(self.datamanager.next_eval(index)[1]["start"]) for index in range(GAP_CLIPS)]
        return gaps(rollout, [(start, self.config.options.clips.clip_frames or 1) for start in starts])

    def get_training_callbacks(self, training_callback_attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """After each step the norms of its gradients go to the log."""
        return [
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._log_gradients, update_every_num_iters=1),
        ]

    def _log_gradients(self, step: int) -> None:
        self.completed = step
        for group, parameters in self.model.get_param_groups().items():
            found = [p.grad for p in parameters if p.grad is not None]
            if found:
                writer.put_scalar(f"gradient/{group}", torch.stack([g.norm() for g in found]).norm(), step)

    @torch.no_grad()
    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, float]:
        """What ns-eval writes, as means over the evaluation views: fidelity of the frozen scene against those of their
        photographs that are there, how many these are, how much the weather changes of the pictures, pictures per second; and
        the drift of the motion."""
        self.eval()
        model, rows, compared = self.model, [], 0
        views = self.datamanager.evaluated
        for index, (camera, _) in enumerate(self.datamanager.fixed_indices_eval_dataloader):
            began = time.perf_counter()
            snowed = model.get_outputs_for_camera(camera)["rgb"]
            row = {"fps": 1.0 / (time.perf_counter() - began)}
            frozen = model.render(from_nerfstudio(camera).to(model.device), None).rgb[0].clamp(0, 1)
            row["changed_by_weather"] = float((snowed - frozen).abs().mean())
            seen = views.photograph(index, model.background_color)
            if seen is not None and seen.known.any():
                compared += 1
                likeness = fidelity(frozen, seen.rgb.to(frozen), seen.known.to(frozen.device))
                row |= {f"frozen_{name}": value for name, value in likeness.items()}
            rows.append(row)
            if output_path is not None:
                output_path.mkdir(parents=True, exist_ok=True)
                pair = torch.cat([frozen, snowed], dim=1).permute(2, 0, 1)
                torchvision.utils.save_image(pair.cpu(), output_path / f"eval_{index:04d}.png")
        names = dict.fromkeys(name for row in rows for name in row)
        columns = {name: torch.tensor([row[name] for row in rows if name in row]) for name in names}
        result = {name: float(values.nanmean()) for name, values in columns.items()}
        if get_std and len(rows) > 1:
            result |= {f"{name}_std": float(values.std()) for name, values in columns.items()}
        if views.prepared.scene.photographs and compared < len(rows):
            console.print(f"{len(rows) - compared} of {len(rows)} photographs are missing: no fidelity is measured there")
        self.train()
        return {**result, "photographs": float(compared), "drift_m": drift(model.rollout.frames())}

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:  # type: ignore[override]
        """Always strict, where nerfstudio would silently keep what it does not find.

        Raises:
            RunError: the checkpoint does not fit.
        """
        prefix = "_model."
        self._model.load_state_dict({k.removeprefix(prefix): v for k, v in state_dict.items() if k.startswith(prefix)})


def _memory(device: torch.device) -> float:
    """MB: the most that the process has held of a GPU so far, or what it holds of the machine's memory now."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    return psutil.Process().memory_info().rss / 1e6
