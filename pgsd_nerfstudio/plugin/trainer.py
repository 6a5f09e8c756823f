"""nerfstudio's Trainer, saved again once everything is known, and kind to an interrupting user."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Literal

from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.rich_utils import CONSOLE

from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import WeatherOptions


class WeatherTrainer(Trainer):
    """Trains one weather on one device."""

    config: Any  # WeatherTrainerConfig, whose module imports this one

    def __init__(self, config: Any, local_rank: int = 0, world_size: int = 1) -> None:
        if world_size > 1:
            raise RunError(f"one device trains one weather, found {world_size}; use --machine.num-devices 1")
        super().__init__(config, local_rank, world_size)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio; then config.yml is written again with the defaults that only the opened video prior could tell."""
        super().setup(test_mode)
        settled = self.config.pipeline.options
        for f in fields(WeatherOptions):
            setattr(self.config, f.name, getattr(settled, f.name))
        self.config.save_config()

    def train(self) -> None:
        """Train to the end, or to Ctrl-C: then what was learned so far is saved, and the way to go on is said."""
        try:
            super().train()
        except KeyboardInterrupt:
            self.save_checkpoint(self.step)
            CONSOLE.print(
                f"Interrupted at step {self.step}; to go on, add to the same command: --load-dir {self.checkpoint_dir}"
            )
            return
        except RunError:
            # Nothing of the steps before is lost to what broke this one.
            self.save_checkpoint(self.step)
            CONSOLE.print(f"Stopped at step {self.step}; what was learned lies in {self.checkpoint_dir}", soft_wrap=True)
            raise
        config = self.config.get_base_dir() / "config.yml"
        stage: Any = self.pipeline.model.stage
        CONSOLE.print(f"Frozen scene while training: {stage.clip_rasterizer.memory}", soft_wrap=True)
        CONSOLE.print(f"Look at it: ns-viewer --load-config {config}", soft_wrap=True)
        CONSOLE.print(f"A video: ns-render interpolate --load-config {config} --output-path snow.mp4", soft_wrap=True)
