"""Prepare the answer of a scene to a weather: exposure by rays, the sun from its shadows, haze from the box of air."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.casting import casting
from pgsd_nerfstudio.response.coating import Coating
from pgsd_nerfstudio.response.edited import edits_key, fit_edits
from pgsd_nerfstudio.response.edited_pictures import read_edited
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.response.exposure import LEVEL, Exposure, most_hidden
from pgsd_nerfstudio.response.haze_field import HazeField
from pgsd_nerfstudio.response.layer import Layer
from pgsd_nerfstudio.response.layer_making import layer_of
from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.response.puddle_making import puddles_of, stored_water, water_of
from pgsd_nerfstudio.response.rays import open_sky, ray_starts
from pgsd_nerfstudio.response.shadow_borders import Shade, plausible, seen_by_colors, sun_colors
from pgsd_nerfstudio.response.sky import sky_share
from pgsd_nerfstudio.response.sunlight import Sunlight, find_sunlight, lit, overcast_factor
from pgsd_nerfstudio.scene.frame import attention
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0
from pgsd_nerfstudio.storage import cache_dir, content_key, load_tensors, save_tensors
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

SOLID = 0.3  # opacity from which the colour of a Gaussian counts in the search for the sun
SKY_RAYS = 24  # per Gaussian, for the light of the sky under which shadows are compared
MOST_SOFTENING = 8.0  # greatest factor and, inverse, least; shadows hold noise, which would be too bright with more
_REVISION = 11  # of the computation; stored answers of another revision are not used


def answer_of(
    scene: Scene, surface: SurfaceMesh, effect: Effect, *, seconds: float, seed: int = 0, edits: Edits | None = None
) -> Answer:
    """The answer of a scene to an effect. Its costly parts are computed once and then read from the cache.

    Args:
        scene: the frozen scene.
        surface: its mesh in metres, which casts shadows and shelters.
        effect: the weather.
        seconds: second at which the edits are reached in full.
        seed: of rays, patches and the variation of the cover.
        edits: change by edited pictures, from `edits_of`.

    Raises:
        OSError: the cache could not be written.
    """
    # The file holds only the results of rays, so its key holds only the inputs of the rays.
    parts = (effect.emission, effect.material, effect.wind, effect.ambience, effect.surface.landing)
    parts += (effect.surface.unevenness,)
    key = content_key("answer", _REVISION, scene.content_key(), surface.vertices, surface.triangles, *parts, seed)
    path = cache_dir() / "answers" / f"{key}.safetensors"
    answer = stored_answer(path, scene, effect, seconds=seconds, seed=seed)
    if answer is None:
        metric = to_metric(scene)
        exposure = Exposure.of(metric, surface, effect, seed=seed)
        sky = sky_of(scene, metric)
        softening = softening_of(metric, exposure, surface, effect, sky, seed=seed)
        layer = layer_of(scene, metric, surface, effect, seed=seed)
        # Mirrors show the surroundings without the shadows that the clouds take.
        clouded = metric if softening is None else replace(metric, colors=encoded(linear(metric.colors) * softening))
        water = water_of(scene, clouded, surface, effect, sky, seed=seed)
        answer = composed(scene, effect, exposure, softening, seconds=seconds, seed=seed, layer=layer, water=water)
        save_answer(path, answer)
    return replace(answer, edits=edits)


def save_answer(path: Path, answer: Answer) -> None:
    """Store the exposure, the softening, the layer and the edits of an answer, for `stored_answer`.

    Raises:
        OSError: the file could not be written.
    """
    tensors = {f.name: getattr(answer.exposure, f.name) for f in fields(Exposure)}
    if answer.softening is not None:
        tensors["softening"] = answer.softening
    if answer.layer is not None:
        tensors |= {f"layer.{name}": tensor for name, tensor in answer.layer.tensors.items()}
    if answer.puddles is not None:
        tensors |= {f"water.{name}": tensor for name, tensor in stored_water(answer.puddles).items()}
    if answer.edits is not None:
        tensors |= {f"edited.{name}": tensor for name, tensor in answer.edits.tensors.items()}
    save_tensors(path, tensors, {"revision": _REVISION})


def stored_answer(path: Path, scene: Scene, effect: Effect, *, seconds: float, seed: int = 0) -> Answer | None:
    """Read a stored answer.

    Args:
        path: file of `save_answer`.
        scene: the frozen scene that the answer was made for.
        effect: the weather.
        seconds: as for `answer_of`.
        seed: as for `answer_of`.

    Returns:
        None if the file is missing or damaged, or belongs to another scene or revision.
    """
    stored = load_tensors(path)
    if stored is None or stored[1].get("revision") != _REVISION:
        return None
    tensors = stored[0]
    softening = tensors.pop("softening", None)
    edited, lying = _taken(tensors, "edited."), _taken(tensors, "layer.")
    water = _taken(tensors, "water.")
    if set(tensors) != {f.name for f in fields(Exposure)} or len(tensors["sky"]) != len(scene.gaussians):
        return None
    return composed(
        scene,
        effect,
        Exposure(**tensors),
        softening,
        seconds=seconds,
        seed=seed,
        edits=Edits(**edited) if edited else None,
        layer=Layer(**lying, frame=scene.frame) if lying else None,
        water=water,
    )


def _taken(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Take the tensors whose name has a prefix out of a dictionary; their names without it."""
    return {name.removeprefix(prefix): tensors.pop(name) for name in list(tensors) if name.startswith(prefix)}


def composed(
    scene: Scene,
    effect: Effect,
    exposure: Exposure,
    softening: Float[Tensor, "n 3"] | None = None,
    *,
    seconds: float = 10.0,
    seed: int = 0,
    edits: Edits | None = None,
    layer: Layer | None = None,
    water: dict[str, Tensor] | None = None,
) -> Answer:
    """The answer from the results of rays; haze and coating follow from the effect.

    Args:
        scene: the frozen scene.
        effect: the weather.
        exposure: of the frozen Gaussians.
        softening: factors on linear red, green and blue in full weather; None: no sun was found.
        seconds: second at which the edits are reached in full.
        seed: of patches and the variation of the cover.
        edits: change by edited pictures.
        layer: cover on the surface of the scene.
        water: of `water_of`; None: no water stands.
    """
    metric, centers = to_metric(scene), scene.frame.to_metric(scene.cameras.centers)
    sky = sky_of(scene, metric)
    below = replace(exposure, catches=exposure.catches * (1 - sky))  # nothing lies on the sky
    return Answer(
        effect=effect,
        exposure=exposure,
        coating=Coating.of(effect, below, metric.means, seed=seed, most=most_hidden(metric, exposure, centers)),
        softening=softening,
        up=scene.frame.rotation,
        metres_per_unit=scene.frame.metres_per_unit,
        haze=HazeField.of(effect, scene.frame, domain_of(scene), seed=seed),
        edits=edits,
        sky=sky if bool((sky > 0).any()) else None,
        layer=layer,
        puddles=puddles_of(water or {}, scene, metric, effect, exposure),
        seconds=seconds,
    )


def sky_of(scene: Scene, metric: Gaussians) -> Float[Tensor, " n"]:
    """Share of each Gaussian that is sky, 0..1.

    Args:
        scene: the frozen scene.
        metric: its Gaussians in metres, with plain RGB.
    """
    _, radius = attention(scene.cameras, scene.gaussians)
    return sky_share(metric, scene.frame.to_metric(scene.cameras.centers), radius * scene.frame.metres_per_unit)


def edits_of(scene: Scene, folder: Path, device: torch.device | str, *, seed: int = 0) -> Edits:
    """The edits that edited pictures of a scene's views ask for. They are fitted once and then read from the cache; an
    interrupted fit resumes.

    Args:
        scene: the frozen scene.
        folder: holds the edited pictures.
        device: device of the fit.
        seed: of the order of the views.

    Raises:
        ValueError: the folder holds no picture of a view, or one that cannot be read.
        FloatingPointError: the fit found no finite gradient, several steps in a row.
        OSError: the cache could not be written.
    """
    pictures = read_edited(folder, scene)
    key = edits_key(scene, pictures, seed=seed, device=device)
    path = cache_dir() / "edits" / f"{key}.safetensors"
    edits = Edits.load(path, key)
    if edits is None:
        edits = fit_edits(scene, pictures, seed=seed, device=device, resume=path.with_suffix(".unfinished.safetensors"))
        edits.save(path, key)
    return edits


def to_metric(scene: Scene) -> Gaussians:
    """The frozen Gaussians in metres, with plain RGB without dependence on the direction."""
    frozen = scene.gaussians
    plain = 0.5 + SH_C0 * (frozen.colors if frozen.colors.ndim == 2 else frozen.colors[:, 0])
    return scene.frame.gaussians_to_metric(replace(frozen, colors=plain))


def softening_of(
    metric: Gaussians, exposure: Exposure, surface: SurfaceMesh, effect: Effect, sky: Float[Tensor, " n"], *, seed: int = 0
) -> Float[Tensor, "n 3"] | None:
    """Factors on linear red, green and blue in full weather, when the clouds of the ambience take the sun.

    Args:
        metric: the frozen Gaussians in metres, with plain RGB.
        exposure: of these Gaussians.
        surface: mesh of the scene in metres.
        effect: its ambience gives the clouds.
        sky: share of each Gaussian that is sky, which no sun shines on.
        seed: of the rays.

    Returns:
        None if the effect has no clouds or no sun was found.
    """
    if effect.ambience is None or effect.ambience.clouds == 0:
        return None
    mesh = casting(surface, metric)
    sun = sun_of(metric, exposure, mesh)
    if sun is None:
        return None
    light, starts = linear(metric.colors), ray_starts(metric.means, exposure.normals, mesh)
    opened, _ = open_sky(starts, exposure.normals.cpu(), mesh, SKY_RAYS, torch.Generator().manual_seed(seed))
    by_mesh = lit(sun, metric.means, exposure.normals, mesh)
    shade = Shade.of(sun, metric.means, exposure.normals, light, by_mesh, opened, metric.opacities > SOLID)
    ratios = sun_colors(shade, ~exposure.loose & (exposure.level > LEVEL), sun)
    share = seen_by_colors(shade, ratios)
    clouds, seen = effect.ambience.clouds, shade.cosines * share
    factors = [overcast_factor(replace(sun, ratio=ratio), seen, opened, clouds) for ratio in ratios.tolist()]
    found = torch.stack(factors, dim=1) * plausible(shade, ratios, share)[:, None] ** clouds
    return torch.lerp(found.clamp(1 / MOST_SOFTENING, MOST_SOFTENING), torch.ones(3), sky[:, None])


def sun_of(metric: Gaussians, exposure: Exposure, surface: SurfaceMesh) -> Sunlight | None:
    """The sun of a captured scene, from the shadows in the colours of level and solid Gaussians; None if no sun was found.

    Args:
        metric: the frozen Gaussians in metres, with plain RGB.
        exposure: of these Gaussians.
        surface: mesh of the scene in metres.
    """
    level = (exposure.level > LEVEL) & (metric.opacities > SOLID)
    light = luminance(linear(metric.colors))
    return find_sunlight(metric.means[level], exposure.normals[level], light[level], surface)
