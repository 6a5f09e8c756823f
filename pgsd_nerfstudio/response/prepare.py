"""The answer of a scene to a weather, made once: exposure by rays, the sun by its shadows, haze by the box of air."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.spherical_harmonics import SH_C0
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.coating import Coating
from pgsd_nerfstudio.response.edited import edits_key, fit_edits
from pgsd_nerfstudio.response.edited_pictures import read_edited
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.response.exposure import LEVEL, Exposure
from pgsd_nerfstudio.response.haze_field import HazeField
from pgsd_nerfstudio.response.light import linear, luminance
from pgsd_nerfstudio.response.sunlight import Sunlight, find_sunlight, lit, overcast_factor
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import cache_dir, content_key, load_tensors, save_tensors
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

SOLID = 0.3  # opacity from which a Gaussian's colour is asked for the sun
NEIGHBOURS = 16
MOST_SOFTENING = 3.0  # a shadow's colours hold noise and bounced light, which would shine
_REVISION = 2  # of what is computed; stored answers of another one are not used


def answer_of(
    scene: Scene, surface: SurfaceMesh, effect: Effect, *, seconds: float, seed: int = 0, edits: Edits | None = None
) -> Answer:
    """How a scene answers an effect; what is costly is computed once and then read from the cache.

    Args:
        seconds: length of the weather: when edited pictures are reached.

    Raises:
        OSError: the cache could not be written.
    """
    # Only what rays find out is kept, so only what they depend on names the file.
    parts = (effect.emission, effect.material, effect.wind, effect.ambience)
    key = content_key("answer", _REVISION, scene.content_key(), surface.vertices, surface.triangles, *parts, seed)
    path = cache_dir() / "answers" / f"{key}.safetensors"
    answer = stored_answer(path, scene, effect, seconds=seconds, seed=seed)
    if answer is None:
        metric = to_metric(scene)
        exposure = Exposure.of(metric, surface, effect, seed=seed)
        softening = softening_of(metric, exposure, surface, effect)
        answer = composed(scene, effect, exposure, softening, seconds=seconds, seed=seed)
        save_answer(path, answer)
    return replace(answer, edits=edits)


def save_answer(path: Path, answer: Answer) -> None:
    """Store what was computed by rays, for `stored_answer`.

    Raises:
        OSError: the file could not be written.
    """
    tensors = {f.name: getattr(answer.exposure, f.name) for f in fields(Exposure)}
    if answer.softening is not None:
        tensors["softening"] = answer.softening
    if answer.edits is not None:
        tensors |= {f"edited.{name}": tensor for name, tensor in answer.edits.tensors.items()}
    save_tensors(path, tensors, {"revision": _REVISION})


def stored_answer(path: Path, scene: Scene, effect: Effect, *, seconds: float, seed: int = 0) -> Answer | None:
    """The answer of a file; None where there is none, or where it is damaged or of another scene or version."""
    stored = load_tensors(path)
    if stored is None or stored[1].get("revision") != _REVISION:
        return None
    tensors = stored[0]
    softening = tensors.pop("softening", None)
    edited = {name.removeprefix("edited."): tensors.pop(name) for name in list(tensors) if name.startswith("edited.")}
    if set(tensors) != {f.name for f in fields(Exposure)} or len(tensors["sky"]) != len(scene.gaussians):
        return None
    edits = Edits(**edited) if edited else None
    return composed(scene, effect, Exposure(**tensors), softening, seconds=seconds, seed=seed, edits=edits)


def composed(
    scene: Scene,
    effect: Effect,
    exposure: Exposure,
    softening: Float[Tensor, " n"] | None = None,
    *,
    seconds: float = 10.0,
    seed: int = 0,
    edits: Edits | None = None,
) -> Answer:
    """The answer from what rays have found out; haze and layers follow from the effect."""
    return Answer(
        effect=effect,
        exposure=exposure,
        coating=Coating.of(effect, exposure, scene.frame.to_metric(scene.gaussians.means), seed=seed),
        softening=softening,
        up=scene.frame.rotation,
        metres_per_unit=scene.frame.metres_per_unit,
        haze=HazeField.of(effect, scene.frame, domain_of(scene), seed=seed),
        edits=edits,
        seconds=seconds,
    )


def edits_of(scene: Scene, folder: Path, device: torch.device | str, *, seed: int = 0) -> Edits:
    """The change of the scene that edited pictures of its views ask for; fitted once, interruptible, kept in the cache.

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
    """The frozen Gaussians in metres; plain colours."""
    frozen = scene.gaussians
    plain = 0.5 + SH_C0 * (frozen.colors if frozen.colors.ndim == 2 else frozen.colors[:, 0])
    return scene.frame.gaussians_to_metric(replace(frozen, colors=plain))


def softening_of(metric: Gaussians, exposure: Exposure, surface: SurfaceMesh, effect: Effect) -> Float[Tensor, " n"] | None:
    """Factor on linear light when the ambience's clouds have come; None where they change nothing or no sun is found."""
    if effect.ambience is None or effect.ambience.clouds == 0:
        return None
    sun = sun_of(metric, exposure, surface)
    if sun is None:
        return None
    seen = lit(sun, metric.means, exposure.normals, surface)
    factor = overcast_factor(sun, seen, exposure.sky, effect.ambience.clouds).clamp(1 / MOST_SOFTENING, MOST_SOFTENING)
    # Shadows of a mesh lie some centimetres beside those of the picture: what neighbours share leaves no bright rims.
    _, around = KDTree(metric.means.numpy()).query(metric.means.numpy(), min(NEIGHBOURS, len(factor)))
    return factor.log()[torch.from_numpy(around).reshape(len(factor), -1)].mean(1).exp()


def sun_of(metric: Gaussians, exposure: Exposure, surface: SurfaceMesh) -> Sunlight | None:
    """The sun by the shadows in a scene's own colours, asked of what lies smoothly in its surface; None: there is none."""
    asked = (exposure.level > LEVEL) & (metric.opacities > SOLID)
    light = luminance(linear(metric.colors))
    return find_sunlight(metric.means[asked], exposure.normals[asked], light[asked], surface)
