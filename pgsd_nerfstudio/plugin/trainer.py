"""nerfstudio's Trainer, saved again once everything is known, and kind to an interrupting user."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.pipeline import WeatherPipeline
from pgsd_nerfstudio.refusal import INTERRUPTED

NAMES = {"simulation": "simulation", "rollout": "roll-out"}


class WeatherTrainer(Trainer):
    """Trains one weather on one device."""

    config: Any  # WeatherTrainerConfig, whose module imports this one
    pipeline: WeatherPipeline

    def __init__(self, config: Any, local_rank: int = 0, world_size: int = 1) -> None:
        if world_size > 1:
            raise RunError(f"one device trains one weather, found {world_size}; use --machine.num-devices 1")
        super().__init__(config, local_rank, world_size)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio; then config.yml is written, with the defaults that only the opened video prior could tell. A run that
        is refused on the way leaves no folder; one that was there before stays.

        Raises:
            SceneError, RunError: as the pipeline.
        """
        made = [folder for folder in (self.base_dir, *self.base_dir.parents) if not folder.exists()]
        try:
            self.base_dir.mkdir(parents=True, exist_ok=True)
            super().setup(test_mode)
            self.config.run = self.config.pipeline.options
            self.config.write_config()
        except BaseException as error:
            _remove(made)
            if isinstance(error, KeyboardInterrupt):
                CONSOLE.print(
                    "Interrupted before training began; what was simulated so far is cached, the same command goes on"
                )
                sys.exit(INTERRUPTED)
            raise

    def train(self) -> None:
        """Train to the end, or to Ctrl-C: then what was learned so far is saved, and the way to go on is said.

        A run that was broken off goes on to the end that it was given and, on a CPU, to the same bits.
        """
        self.config.max_num_iterations -= self._start_step
        try:
            super().train()
        except KeyboardInterrupt:
            if self._kept():
                again = f"to go on, add to the same command: --load-dir {self.checkpoint_dir}"
                CONSOLE.print(f"Interrupted after step {self.pipeline.completed}; {again}", soft_wrap=True)
            sys.exit(INTERRUPTED)
        except RunError:
            # Nothing of the steps before is lost to what broke this one.
            if self._kept():
                CONSOLE.print(
                    f"What was learned until step {self.pipeline.completed} lies in {self.checkpoint_dir}", soft_wrap=True
                )
            raise
        config = self.config.get_base_dir() / "config.yml"
        prepared: Any = self.pipeline.model.prepared
        for begin, gap in self.pipeline.drift_gaps().items():
            writer.put_scalar(f"gap/{begin}_m", gap.difference, self.config.max_num_iterations)
            CONSOLE.print(
                f"Drift of clips that begin at the {NAMES[begin]}: {1000 * gap.clips:.2f} mm, of the whole video at the same "
                f"frames {1000 * gap.rollout:.2f} mm: unseen {1000 * gap.difference:.2f} mm",
                soft_wrap=True,
            )
        writer.write_out_storage()
        CONSOLE.print(f"Frozen scene while training: {prepared.clip_rasterizer.memory}", soft_wrap=True)
        CONSOLE.print(f"Look at it: ns-viewer --load-config {config}", soft_wrap=True)
        video = f"{self.config.run.chosen_effect().name}.mp4"
        CONSOLE.print(f"A video: pgsd render --load-config {config} --output {video}", soft_wrap=True)

    def _kept(self) -> bool:
        """Save what the last whole step has learned; False where there was none."""
        if self.pipeline.completed is None:
            CONSOLE.print("Interrupted before the first step was done: nothing is learned yet")
            return False
        self.save_checkpoint(self.pipeline.completed)
        return True


def _remove(made: Sequence[Path]) -> None:
    """Remove the folders that this run has made: the first with what it holds, those above it where nothing else is in them."""
    for folder in made[:1]:
        shutil.rmtree(folder, ignore_errors=True)
    for folder in made[1:]:
        with suppress(OSError):
            folder.rmdir()
