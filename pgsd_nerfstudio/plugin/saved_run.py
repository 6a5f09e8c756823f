"""Open a trained run without running anything that its files say: config.yml is read as data, the checkpoint as tensors.

nerfstudio's own commands make Python objects of whatever config.yml names; this is the way for a run from elsewhere.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from pydantic import TypeAdapter, ValidationError

from pgsd_nerfstudio.plugin.checkpoints import FOLDER, checkpoint_in, read_checkpoint
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import RunOptions, check_version
from pgsd_nerfstudio.plugin.pipeline import WeatherPipelineConfig
from pgsd_nerfstudio.scene.run_config import entry, read_run_config
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.weather.weather import Weather


def open_run(path: Path) -> Weather:
    """The weather of a run as it was trained.

    Args:
        path: the run's folder, or the config.yml in it.

    Raises:
        RunError: it is no run of this method and version, or a file of it is missing or damaged.
        SceneError: its scene cannot be used.
    """
    config_path = path / "config.yml" if path.is_dir() else path
    folder = config_path.resolve().parent
    options, made_in = read_options(config_path)
    stored = read_checkpoint(checkpoint_in(folder / FOLDER))
    config = WeatherPipelineConfig(run_folder=folder)
    config.share(options)
    config.datamanager.made_in = made_in
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pipeline = config.setup(device=device, test_mode="test")
    pipeline.load_pipeline(stored["pipeline"], int(stored["step"]))
    return pipeline.model.made


def read_options(config_path: Path) -> tuple[RunOptions, Path | None]:
    """The options of a run, and where its folder was when it was made; None if that is not said.

    Args:
        config_path: its config.yml.

    Raises:
        RunError: it is not the config.yml of a run of this method and version.
    """
    if not config_path.is_file():
        raise RunError(f"there is no run at {config_path}: expected the config.yml that ns-train pgsd-weather wrote")
    try:
        config = read_run_config(config_path)
    except SceneError as error:
        raise RunError(str(error)) from error
    if entry(config, "method_name") != "pgsd-weather":
        raise RunError(f"{config_path} is the run of another method ({entry(config, 'method_name')}): expected pgsd-weather")
    check_version(entry(config, "run", "version"))
    made_in = entry(config, "pipeline", "run_folder")
    try:
        options = TypeAdapter(RunOptions).validate_python(entry(config, "run"))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise RunError(
            f"{config_path} is damaged: {where} of its run cannot be used ({first['msg']}); train it again"
        ) from error
    try:
        options.simulation.check()
    except ValueError as error:
        raise RunError(f"{config_path} is damaged: {error}") from error
    # What the words of the weather mean was settled when it was made: a file must not have a language model asked, at an
    # address that it names and with the user's key.
    asking_nobody = replace(options.weather, llm=None, llm_url=None)
    return replace(options, weather=asking_nobody), made_in if isinstance(made_in, Path) else None
