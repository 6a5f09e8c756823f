"""A splatfacto run without its training: nerfstudio's own config, dataparser, optimizers and file names around a splat."""

from __future__ import annotations

import copy
from pathlib import Path

import roma
import torch
import yaml
from jaxtyping import Float
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.reading import read_splat

STEP = 29_999


def write_splatfacto_run(outputs: Path, ply: Path, data: Path) -> Path:
    """The folder that `ns-train splatfacto --data DATA` leaves, holding the splat of `ply`.

    The splat is moved from the coordinates of the poses in `data` to those that the run's dataparser makes of them.
    """
    config = copy.deepcopy(method_configs["splatfacto"])
    config.output_dir, config.experiment_name, config.timestamp = outputs, data.name, "2024-01-01_000000"
    config.data = config.pipeline.datamanager.data = data
    gaussians = read_splat(ply).gaussians
    config.pipeline.model.sh_degree = gaussians.sh_degree
    run = config.get_base_dir()
    run.mkdir(parents=True)
    (run / "config.yml").write_text(yaml.dump(config), "utf8")

    parsed = NerfstudioDataParserConfig(data=data).setup().get_dataparser_outputs(split="train")
    parsed.save_dataparser_transform(run / "dataparser_transforms.json")
    saved_to_run, scale = to_run(data)
    parameters = {name: torch.nn.Parameter(value) for name, value in raw(moved(gaussians, saved_to_run, scale)).items()}
    write_checkpoint(run / config.relative_model_dir / f"step-{STEP:09d}.ckpt", parameters, config)
    return run


def to_run(data: Path) -> tuple[Float[Tensor, "3 4"], float]:
    """What nerfstudio's dataparser does to the poses, found by comparing them before and after."""
    plain = NerfstudioDataParserConfig(
        data=data, orientation_method="none", center_method="none", auto_scale_poses=False, eval_mode="all"
    )
    before, after = (
        config.setup().get_dataparser_outputs(split="train").cameras.camera_to_worlds.double()
        for config in (plain, NerfstudioDataParserConfig(data=data, eval_mode="all"))
    )
    rotation = after[0, :, :3] @ before[0, :, :3].T
    far = (before[:, :, 3] - before[0, :, 3]).norm(dim=1).argmax()
    scale = float((after[far, :, 3] - after[0, :, 3]).norm() / (before[far, :, 3] - before[0, :, 3]).norm())
    shift = after[0, :, 3] / scale - rotation @ before[0, :, 3]
    return torch.cat([rotation, shift[:, None]], dim=1), scale


def moved(gaussians: Gaussians, transform: Float[Tensor, "3 4"], scale: float) -> Gaussians:
    """x -> scale * (R x + t) for Gaussians whose colours are spherical harmonics of degree 0 or 1."""
    rotation = transform[:, :3].float()
    turn = roma.rotmat_to_unitquat(rotation).expand(len(gaussians), 4)
    colors = gaussians.colors.clone()
    if gaussians.sh_degree == 1:
        # Degree 1 is proportional to (-y, z, -x) of the direction, so its coefficients turn like a vector.
        vectors = torch.stack([-colors[:, 3], -colors[:, 1], colors[:, 2]], dim=1)
        x, y, z = torch.einsum("ij,njc->inc", rotation, vectors)
        colors[:, 1:] = torch.stack([-y, z, -x], dim=1)
    return Gaussians(
        scale * (gaussians.means @ rotation.T + transform[:, 3].float()),
        roma.quat_xyzw_to_wxyz(roma.quat_product(turn, roma.quat_wxyz_to_xyzw(gaussians.quats))),
        scale * gaussians.scales,
        gaussians.opacities,
        colors,
    )


def raw(gaussians: Gaussians) -> dict[str, Tensor]:
    """Splatfacto's parameters, as its optimizers move them."""
    return {
        "means": gaussians.means,
        "scales": gaussians.scales.log(),
        "quats": gaussians.quats,
        "features_dc": gaussians.colors[:, 0],
        "features_rest": gaussians.colors[:, 1:],
        "opacities": gaussians.opacities.clamp(1e-6, 1 - 1e-6).logit()[:, None],
    }


def write_checkpoint(path: Path, parameters: dict[str, torch.nn.Parameter], config) -> None:
    """As nerfstudio's Trainer.save_checkpoint writes it, with the state of real optimizers and schedulers after one step."""
    groups = {name: [parameter] for name, parameter in parameters.items()}
    optimizers = Optimizers({name: copy.deepcopy(config.optimizers[name]) for name in groups}, groups)
    for parameter in parameters.values():
        parameter.grad = torch.zeros_like(parameter)
    optimizers.optimizer_step_all()
    optimizers.scheduler_step_all(STEP)
    state = {f"_model.gauss_params.{name}": parameter.detach() for name, parameter in parameters.items()}
    path.parent.mkdir(parents=True)
    torch.save(
        {
            "step": STEP,
            "pipeline": {"_model.device_indicator_param": torch.empty(0), **state},
            "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.optimizers.items()},
            "schedulers": {name: scheduler.state_dict() for name, scheduler in optimizers.schedulers.items()},
            "scalers": torch.amp.GradScaler("cuda", enabled=False).state_dict(),
        },
        path,
    )
