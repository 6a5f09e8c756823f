"""`ns-train pgsd-weather`: the method's configuration and its entry point.

nerfstudio writes config.yml before any of our objects exist and gives pipeline, data manager and model a configuration each, so
the flags are copied into all three as soon as they are parsed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import CosineDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification
from rich.console import Console

from pgsd_nerfstudio.plugin.environment import prepare
from pgsd_nerfstudio.plugin.known_errors import show_sentences
from pgsd_nerfstudio.plugin.options import RunOptions, check_version
from pgsd_nerfstudio.plugin.pipeline import WeatherPipelineConfig
from pgsd_nerfstudio.plugin.resuming import resumed
from pgsd_nerfstudio.plugin.trainer import WeatherTrainer
from pgsd_nerfstudio.plugin.training_options import CUDA
from pgsd_nerfstudio.weather.options import FLAT

prepare()
show_sentences()

THIS_MACHINE = "127.0.0.1"


@dataclass
class WeatherTrainerConfig(TrainerConfig):
    """Weather for a frozen scene, refined by physics-guided score distillation."""

    _target: type = field(default_factory=lambda: WeatherTrainer)
    run: Annotated[RunOptions, FLAT] = field(default_factory=RunOptions)
    data: tyro.conf.Suppress[Path | None] = None  # --data is of the scene, --prompt of the guidance
    prompt: tyro.conf.Suppress[str | None] = None
    method_name: str | None = "pgsd-weather"
    """Method name."""
    machine: MachineConfig = field(default_factory=lambda: MachineConfig(device_type="cuda" if CUDA else "cpu"))
    """Machine configuration."""
    logging: LoggingConfig = field(default_factory=lambda: LoggingConfig(steps_per_log=1))
    """Logging configuration; every step is logged, since a step takes seconds."""
    viewer: ViewerConfig = field(
        default_factory=lambda: ViewerConfig(quit_on_train_completion=True, websocket_host=THIS_MACHINE)
    )
    """Viewer configuration; training ends by itself also with a viewer, which only this machine can reach unless
    --viewer.websocket-host says otherwise."""
    vis: Literal["tensorboard", "viewer", "viewer+tensorboard", "wandb", "viewer+wandb", "comet", "viewer+comet"] = (
        "tensorboard"
    )
    """Where progress goes; a viewer shares the machine with the training."""
    steps_per_save: int = 10
    """Steps between checkpoints, which are small: so many a crash may cost."""
    steps_per_eval_batch: int = 0
    """Steps between measurements of the drift on a random window; 0: never."""
    steps_per_eval_image: int = 0
    """Steps between pictures for tensorboard; 0: never, since each needs a roll-out."""
    steps_per_eval_all_images: int = 0
    """Steps between pictures of all evaluation views; 0: never."""
    max_num_iterations: tyro.conf.Suppress[int] = 0
    mixed_precision: tyro.conf.Suppress[bool] = False
    optimizers: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    pipeline: tyro.conf.Suppress[WeatherPipelineConfig] = field(default_factory=WeatherPipelineConfig)

    def __post_init__(self) -> None:
        """Check the flags, make paths absolute and hand them on; the entry point's own config, without a scene, passes."""
        if self.run.scene.load_scene is tyro.MISSING:
            return
        run, words = self.run.absolute(), self.run.weather
        if words.llm is not None and words.weather is not None:
            _say(f"asking {words.llm} what {words.weather!r} means")
        run.check()
        self.run = replace(run.with_words_understood(), training_seed=self.machine.seed)
        if self.experiment_name is None:
            self.experiment_name = run.scene.load_scene.stem
        going_on = resumed(self.run, self.load_dir, self.load_step, self.load_checkpoint)
        if going_on is not None:
            for remark in going_on.remarks:
                _say(remark)
            if self.load_dir is not None:
                self.load_step = going_on.step  # asked for the newest, nerfstudio stumbles over other files in the folder
            self.pipeline.resumed_folder = going_on.run_folder
        self.max_num_iterations = run.training_steps
        self.optimizers = {
            group: {
                "optimizer": AdamOptimizerConfig(lr=rate, eps=1e-15),
                "scheduler": CosineDecaySchedulerConfig(warm_up_end=0, learning_rate_alpha=0.0, max_steps=run.training_steps),
            }
            for group, rate in run.rates.items()
        }
        self.pipeline.share(self.run)

    def print_to_terminal(self) -> None:
        """Not all of nerfstudio's fields: what matters is printed as a table once it is settled, the rest is in config.yml.
        Only how the words for the weather were read is said at once, so that a misunderstanding costs nothing."""
        for remark in self.run.remarks():
            _say(remark)

    def save_config(self) -> None:
        """Nothing is written yet, since a run that is refused leaves no folder; the trainer writes it when the run is ready.
        The pipeline is told where the run will lie."""
        self.pipeline.run_folder = self.get_base_dir().resolve()

    def write_config(self) -> None:
        """Write config.yml, with all defaults that have been settled."""
        super().save_config()

    def get_base_dir(self) -> Path:
        """The folder of the run: where its config.yml was opened, wherever it was written."""
        return self.__dict__.get("_opened_in") or super().get_base_dir()

    def __getstate__(self) -> dict[str, Any]:
        """What config.yml holds: not where it was opened."""
        return {name: value for name, value in self.__dict__.items() if name != "_opened_in"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Called when a config.yml is read: other versions are refused, a run that was moved is found where it is now."""
        # Of what the file says: a class knows a version of its own.
        check_version(vars(state["run"]).get("version") if "run" in state else None)
        self.__dict__.update(state)
        opened = _config_being_opened()
        if opened is not None:
            self.__dict__["_opened_in"] = opened.resolve().parent
        if self.run.scene.load_scene is not tyro.MISSING:
            self.pipeline.datamanager.made_in = self.pipeline.run_folder
            self.pipeline.run_folder = self.get_base_dir().resolve()

    def __setattr__(self, name: str, value: Any) -> None:
        """ns-viewer puts a viewer configuration of its own in place of the run's, by which anybody in the network can connect:
        unless its flag names an address, that of the run stays."""
        given = self.__dict__.get("viewer") if name == "viewer" else None
        if given is not None and value.websocket_host == ViewerConfig().websocket_host and not _names_host(sys.argv):
            value = replace(value, websocket_host=given.websocket_host)
            _say(f"the viewer listens on {value.websocket_host}; --viewer.websocket-host names another address")
        super().__setattr__(name, value)


def _config_being_opened() -> Path | None:
    """The config.yml that nerfstudio's eval_setup is reading. It hands on the text alone, and not where it comes from."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == "nerfstudio.utils.eval_utils" and frame.f_code.co_name == "eval_setup":
            return Path(frame.f_locals["config_path"])
        frame = frame.f_back
    return None


def _names_host(arguments: list[str]) -> bool:
    return any(word.replace("_", "-").split("=")[0] == "--viewer.websocket-host" for word in arguments)


def _say(line: str) -> None:
    Console(stderr=True, highlight=False).print(line, style="dim", markup=False)


pgsd_weather = MethodSpecification(
    config=WeatherTrainerConfig(),
    description="Weather that falls, lands and gathers in a frozen splat, refined by physics-guided score distillation.",
)
