"""What a run settled on, as one table at its start: the same values that config.yml keeps."""

from __future__ import annotations

import os

from rich.console import Console
from rich.table import Table

from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.plugin.distiller import Distiller
from pgsd_nerfstudio.plugin.options import WeatherOptions
from pgsd_nerfstudio.plugin.prepared_scene import PreparedScene


def print_summary(
    console: Console, options: WeatherOptions, prepared: PreparedScene, history: ParticleHistory, distiller: Distiller
) -> None:
    """Print the table and, on a CPU, what the shell should say to OpenMP."""
    scene, emission = prepared.scene, options.chosen_effect().emission
    rows = {
        "scene": f"{options.load_scene} ({len(scene.gaussians):,} Gaussians, {len(scene.cameras)} views), {scene.description}",
        "scale and ground": scene.frame.source,
        "device": str(prepared.device),
        "weather": f"{options.weather or options.effect}, {emission.intensity:g} {emission.unit}, "
        f"{options.seconds:g} s at {options.fps:g} fps",
        "particles": f"{len(history):,} ({int(history.collided.sum()):,} of them land)",
        "video prior": f"{distiller.prior.name}",
        "wanted": distiller.wanted,
        "not wanted": distiller.unwanted,
        "clips": f"{options.clip_frames} frames of {options.clip_width}x{options.clip_height}, paths: {options.trajectory}",
        "training": f"{options.training_steps} steps, {options.distillation.variant} with guidance "
        f"{options.distillation.guidance_scale:g}, weights {options.weights}, "
        f"learning rates {options.rates['field']:g} (field) and {options.rates['look']:g} (look)",
    }
    table = Table(title="pgsd-weather", show_header=False, title_justify="left", title_style="bold")
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    if not options.taught:
        name = options.weather or options.effect
        console.print(
            f"[yellow]The bundled prior has only seen snow. Nothing is learned from it for {name}: the run keeps the simulated "
            "motion and the curated look. --prior THUDM/CogVideoX-2b teaches any weather; --steps 60 lets the bundled try.[/]"
        )
    if prepared.device.type == "cpu" and os.environ.get("OMP_WAIT_POLICY", "").lower() != "passive":
        console.print(
            "[yellow]Waiting threads may slow this run several times over: stop it, `export OMP_WAIT_POLICY=passive`, "
            "start again.[/]"
        )
