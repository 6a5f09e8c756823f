"""What a run settled on, as one table at its start: the same values that config.yml keeps."""

from __future__ import annotations

import os

from rich.console import Console
from rich.table import Table

from pgsd_nerfstudio.plugin.distiller import Distiller
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.weather.weather import Weather


def print_summary(console: Console, options: RunOptions, weather: Weather, distiller: Distiller) -> None:
    """Print the table and, on a CPU, what the shell should say to OpenMP.

    Args:
        console: where it goes.
        options: of the run, settled.
        weather: of the run.
        distiller: the opened video prior.
    """
    scene, history, emission = weather.scene, weather.history, weather.effect.emission
    clips, distillation = options.clips, options.guidance.distillation
    name = options.weather.weather or options.weather.effect
    rows = {
        "scene": f"{options.scene.load_scene} ({len(scene.gaussians):,} Gaussians, {len(scene.cameras)} views), "
        f"{scene.description}",
        "scale and ground": scene.frame.source,
        "device": str(weather.prepared.device),
        "weather": f"{name}, {emission.intensity:g} {emission.unit}, "
        f"{options.simulation.seconds:g} s at {options.simulation.fps:g} fps",
        "particles": f"{len(history):,} ({int(history.collided.sum()):,} of them land)",
        "video prior": f"{distiller.prior.name}",
        "wanted": distiller.wanted,
        "not wanted": distiller.unwanted,
        "clips": f"{clips.clip_frames} frames of {clips.clip_width}x{clips.clip_height}, paths: {clips.trajectory}",
        "training": f"{options.training_steps} steps, {distillation.variant} with guidance "
        f"{distillation.guidance_scale:g}, weights {options.motion.weights}, "
        f"learning rates {options.rates['field']:g} (field) and {options.rates['look']:g} (look)",
    }
    table = Table(title="pgsd-weather", show_header=False, title_justify="left", title_style="bold")
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    if not options.taught:
        console.print(
            f"[yellow]The bundled prior has only seen snow. Nothing is learned from it for {name}: the run keeps the simulated "
            "motion and the curated look. --prior THUDM/CogVideoX-2b teaches any weather; --steps 60 lets the bundled try.[/]"
        )
    if weather.prepared.device.type == "cpu" and os.environ.get("OMP_WAIT_POLICY", "").lower() != "passive":
        console.print(
            "[yellow]Waiting threads may slow this run several times over: stop it, `export OMP_WAIT_POLICY=passive`, "
            "start again.[/]"
        )
